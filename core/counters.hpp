// How each sensor of a stream does: how many rows came and how late, what is missing, the NIS of the last minute.
#pragma once
#include <algorithm>
#include <utility>

#include "events.hpp"

namespace pumafuse {

struct Counters {
    Time sensors;
    std::vector<std::int64_t> number;      // (S, PF_COUNTS)
    std::vector<Time> last, left, second;  // (S,), (S,), (S, PF_SECONDS)
    std::vector<double> usual, minute;     // (S,), (S, PF_SECONDS, PF_KINDS)

    explicit Counters(Time sensors)
        : sensors(sensors), number(sensors * PF_COUNTS), last(sensors, PF_ALWAYS), left(sensors, PF_ALWAYS),
          second(sensors * PF_SECONDS, PF_ALWAYS), usual(sensors), minute(sensors * PF_SECONDS * PF_KINDS) {}

    std::int64_t& count(int sensor, int what) { return number[sensor * PF_COUNTS + what]; }

    // A row that came; `newest` is the latest stamp of all then.
    void came(int sensor, Time stamp, Time newest) {
        ++count(sensor, PF_CAME);
        last[sensor] = std::max(last[sensor], stamp);
        if (double* minute = minute_at(sensor, stamp)) {
            const double lateness = double(std::max(newest - stamp, Time(0))) / 1e9;
            minute[ROWS] += 1.0, minute[LATENESS] += lateness, minute[LATEST] = std::max(minute[LATEST], lateness);
        }
    }

    // A row that leaves the window, in the order of time: those that came late are in.
    void leaves(const Event& event, const Fate& fate, Time axes) {
        if (event.is_command()) return;
        look_at_interval(event.source, event.stamp);
        double* minute = minute_at(event.source, event.stamp);
        for (Time a = 0; a < axes; ++a) {
            const Code outcome = fate.outcome[a];
            if (outcome != PF_ABSENT) ++count(event.source, outcome);
            if (!minute || (outcome != PF_FUSED && outcome != PF_REACQUIRED)) continue;
            minute[NIS] += square(fate.innovation[a] / fate.innovation_sd[a]), minute[VALUES] += 1.0;
        }
    }

    // What was counted before goes on: numbers and usual intervals.
    void carry(const pf_counters& before) {
        std::copy_n(before.number, number.size(), number.begin());
        std::copy_n(before.usual, usual.size(), usual.begin());
    }

    void give(const pf_counters& found) const {
        std::copy(number.begin(), number.end(), found.number), std::copy(usual.begin(), usual.end(), found.usual);
        std::copy(last.begin(), last.end(), found.last), std::copy(left.begin(), left.end(), found.left);
        std::copy(second.begin(), second.end(), found.second), std::copy(minute.begin(), minute.end(), found.minute);
    }

    void forget(Time after) {
        for (Time& one : last) one = one > after ? PF_ALWAYS : one;
        for (Time& one : second) one = one > whole_second(after) ? PF_ALWAYS : one;
    }

  private:
    enum { ROWS, LATENESS, LATEST, NIS, VALUES };
    static constexpr std::int64_t FEW = 20, MANY = 100;  // intervals before a usual one is known, and that it is of
    static constexpr double GAP = 1.5;     // usual intervals without a row: one is missing
    static constexpr double SLOWER = 1.1;  // by dropouts in a row the usual interval grows, if a sensor is slower now

    static Time whole_second(Time stamp) { return stamp / 1'000'000'000 - (stamp % 1'000'000'000 < 0); }

    void look_at_interval(int sensor, Time stamp) {
        const Time before = std::exchange(left[sensor], stamp);
        if (before == PF_ALWAYS) return;
        const double interval = double(stamp - before) / 1e9;
        if (++count(sensor, PF_INTERVALS) > FEW && interval > GAP * usual[sensor]) {
            ++count(sensor, PF_DROPOUTS);
            if (++count(sensor, PF_IN_A_ROW) > 1) usual[sensor] *= SLOWER;
            return;
        }
        count(sensor, PF_IN_A_ROW) = 0;
        usual[sensor] += (interval - usual[sensor]) / double(std::min(count(sensor, PF_INTERVALS), MANY));
    }

    // Where the second of a stamp is counted; none if it is over a minute old.
    double* minute_at(int sensor, Time stamp) {
        const Time now = whole_second(stamp), slot = ((now % PF_SECONDS) + PF_SECONDS) % PF_SECONDS;
        Time& there = second[sensor * PF_SECONDS + slot];
        double* found = &minute[(sensor * PF_SECONDS + slot) * PF_KINDS];
        if (now > there) there = now, std::fill_n(found, PF_KINDS, 0.0);
        return now < there ? nullptr : found;
    }
};

}  // namespace pumafuse
