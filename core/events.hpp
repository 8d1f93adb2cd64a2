// Events in one total order, and what a value is before the filter sees it: one policy for tables and streams.
#pragma once
#include <cmath>

#include "model.hpp"

namespace pumafuse {

inline constexpr double FARTHEST = 1e6;  // m or rad; what is farther is a sentinel, no position

struct Event {
    Time time, stamp;
    int source;            // PF_COMMAND or which sensor
    const double* value;   // (A,)
    const double* spread;  // (A,), or none
    Code* known;           // (A,)

    bool is_command() const { return source == PF_COMMAND; }
    bool commands(int axis) const { return is_command() && known[axis] == PF_FUSED; }
    // A command with a possible value, whatever else it is.
    bool gives_command(int axis) const {
        return is_command() && known[axis] != PF_ABSENT && std::fabs(value[axis]) < FARTHEST;
    }
};

// What became of an event's values.
struct Fate {
    double *innovation, *innovation_sd, *noise_scale;  // (A,)
    Code* outcome;                       // (A,)
    std::int16_t* contradicts;
    double *d_innovation = nullptr, *d_variance = nullptr;  // by each of so many `lanes`, `stride` apart
    Time stride = 0;
    int lanes = 0;
};

// Recorded events as a table of rows.
struct Table {
    const pf_events& events;
    const pf_results* results;
    Time axes;

    Event operator[](Time row) const {
        const Time at = row * axes;
        return {events.time[row], events.stamp[row], events.source[row], events.value + at,
                events.spread ? events.spread + at : nullptr, const_cast<Code*>(events.known + at)};
    }

    Fate fate(Time row) const {
        const Time at = row * axes;
        const auto& [innovation, innovation_sd, noise_scale, outcome, contradicts] = *results;
        return {innovation + at, innovation_sd + at, noise_scale + at, outcome + at, contradicts + row};
    }
};

// Whether a command is none: another of its stamp comes after it, or it says again what the row before it says.
//
// A log that fills its command column down to the sensor's rate has one command where the value changes: the value of
// the row before, said again within half a period, is a repetition.
template <class Rows>
bool repeats(const Rows& rows, Time row, int axis, double period, Time begin, Time end) {
    const Event event = rows[row];
    for (Time later = row + 1; later < end && rows[later].time <= event.time; ++later)
        if (rows[later].gives_command(axis)) return true;
    for (Time before = row - 1; before >= begin; --before) {
        const Event earlier = rows[before];
        if (double(event.time - earlier.time) >= 0.5e9 * period) return false;
        if (event.time > earlier.time && earlier.gives_command(axis)) return earlier.value[axis] == event.value[axis];
    }
    return false;
}

// Whether an earlier row of the same source has the same stamp and the same values; of a stamp the last command counts.
template <class Rows>
bool repeats_earlier(const Rows& rows, Time row, Time begin, int axes) {
    const Event event = rows[row];
    for (Time before = row - 1; before >= begin && rows[before].time >= event.time; --before) {
        const Event earlier = rows[before];
        if (earlier.source != event.source || earlier.stamp != event.stamp) continue;
        bool same = true;
        for (int a = 0; a < axes; ++a) {
            const bool absent = earlier.known[a] == PF_ABSENT, other = event.known[a] == PF_ABSENT;
            const double x = earlier.value[a], y = event.value[a];
            same &= absent == other && (absent || x == y || (std::isnan(x) && std::isnan(y)));
        }
        if (same || event.is_command()) return same;
    }
    return false;
}

// What decides on a value: of the model, and of where the axes stand.
struct Policy {
    const Model<double>& model;
    Time origin;  // the first command

    // `whole` is what the row is for all axes: a duplicate, too late, or PF_FUSED; `level` the start level of the axis.
    template <class Rows>
    Code classify(const Rows& rows, Time row, int axis, Time begin, Time end, Code whole, double level) const {
        const Event event = rows[row];
        if (event.known[axis] == PF_ABSENT) return PF_ABSENT;
        const bool possible = std::fabs(event.value[axis]) < FARTHEST;  // neither NaN nor a sentinel such as 3.4e38
        if (event.is_command()) {
            if (!possible) return PF_INVALID;
            return repeats(rows, row, axis, model.axes[axis].period, begin, end) ? PF_DUPLICATE : PF_FUSED;
        }
        if (std::isnan(model.views[event.source * model.axes.size() + axis].sd)) return PF_UNKNOWN;
        if (event.time == PF_NO_STAMP) return PF_INVALID;
        if (whole != PF_FUSED) return whole;
        if (event.time < origin || std::isnan(level)) return PF_BEFORE_START;
        return possible ? PF_FUSED : PF_INVALID;
    }
};

}  // namespace pumafuse
