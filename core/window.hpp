// The last seconds of a stream: rows of events as of a recording, each with the filter's state before it.
//
// A new event is put where its time says; the filter goes back to the state there and runs on, by the pass that fuses a
// recorded run. Commands that act later than the newest measurement wait until one comes after them.
#pragma once
#include <bit>
#include <ranges>

#include "filter.hpp"

struct pf_live {
    pf_port port{};

    virtual ~pf_live() = default;
    virtual bool add(std::int64_t stamp, int source, std::uint64_t bits, std::int64_t oldest) = 0;
    virtual void estimate(std::int64_t time, std::int64_t after, double* outputs, std::int64_t* fused) = 0;
    virtual void read(std::int64_t begin, std::int64_t end, std::int64_t* stamp, std::int16_t* source,
                      const pf_results& results) const = 0;
    virtual void forget(std::int64_t after) = 0;
    virtual void amend(int source, std::int64_t count, const std::int64_t* stamp, const double* before,
                       const double* now) = 0;
};

namespace pumafuse {

template <int N>
class Window final : public pf_live {
  public:
    Window(const Model<double>& model, Time room, Time most)
        : model(model), filter(model), state(filter.at_rest(0)), trial(state), rows(room, size(), state), most(most),
          first(size(), PF_NEVER), numbers(7 * size(), 1.0), codes(2 * size()) {
        double period = 0.0, latency = 0.0;
        for (const Axis<double>& axis : model.axes) period = std::max(period, axis.period);
        for (const Sensor<double>& sensor : model.sensors) latency = std::max(latency, sensor.latency);
        behind = nanoseconds(latency) + nanoseconds(period);
        double* at = numbers.data();
        port = {at, at + size(), codes.data(), at + 2 * size(), at + 3 * size(), NOBODY, PF_NEVER, PF_ALWAYS,
                rows.room(), 0, 0};
    }

    bool add(Time stamp, int source, std::uint64_t bits, Time oldest) override {
        port.contradicts = NOBODY;
        const bool taken = has_room(source == PF_COMMAND ? size() : 1, stamp, oldest);
        if (taken) source == PF_COMMAND ? add_command(stamp, bits) : add_measurement(stamp, source, bits);
        run(target);
        port.room = rows.room(), port.begin = begin, port.end = end;
        return taken;
    }

    void estimate(Time time, Time after, double* outputs, Time* fused) override {
        if (port.origin == PF_NEVER) {
            std::fill_n(outputs, PF_OUTPUTS * size(), std::nan("")), std::fill_n(fused, size(), PF_NEVER);
            return;
        }
        time = std::max(time, port.origin);
        Time hidden = after == PF_NEVER ? done : begin;
        while (hidden < done && rows[hidden].stamp <= after) ++hidden;
        const Time until = first_after(time), stamped = std::min(time, after);
        Time row = std::min({hidden, done, until});
        trial = row < done ? rows.at(row).before : state;
        std::int16_t contradicts;
        const Fate unused{&numbers[4 * size()], &numbers[5 * size()], &numbers[6 * size()], &codes[size()],
                          &contradicts};
        for (; row < until; ++row)  // what is valid by then, without what is hidden
            if (rows[row].stamp <= (row < done ? after : stamped)) filter.step(trial, rows[row], unused);
        filter.estimate(trial, rows, until, end, time, stamped, outputs);
        for (Time a = 0; a < size(); ++a) {
            outputs[a] += trial.axes[a].response.start;  // positions come first
            fused[a] = port.origin;
            for (const Gate& gate : trial.gates[a].sensor) fused[a] = std::max(fused[a], gate.fused_at);
        }
    }

    void read(Time begin, Time end, Time* stamp, std::int16_t* source, const pf_results& results) const override {
        for (Time row = begin; row < end; ++row) {
            const Fate fate = rows.fate(row);
            const Time to = row - begin, at = to * size();
            stamp[to] = rows[row].stamp, source[to] = std::int16_t(rows[row].source);
            results.contradicts[to] = *fate.contradicts;
            std::copy_n(fate.outcome, size(), results.outcome + at);
            std::copy_n(fate.innovation, size(), results.innovation + at);
            std::copy_n(fate.innovation_sd, size(), results.innovation_sd + at);
            std::copy_n(fate.noise_scale, size(), results.noise_scale + at);
        }
    }

    void forget(Time after) override {
        restore(begin);
        Time kept = begin, wanted = begin;
        for (Time row = begin; row < end; ++row) {
            if (rows[row].stamp > after) continue;
            wanted += row < target;
            std::swap(rows.at(kept++), rows.at(row));
        }
        end = kept, target = wanted;
        if (port.origin > after) port.origin = PF_NEVER;
        for (Time a = 0; a < size(); ++a) {
            if (first[a] > after && first[a] < PF_NEVER) first[a] = PF_NEVER, rest(a, model.axes[a].start);
            reclassify(a, begin, PF_NEVER);
        }
        run(target);
        port.end = end;
    }

    void amend(int source, Time count, const Time* stamp, const double* before, const double* now) override {
        const Time latency = nanoseconds(model.sensors[source].latency);
        for (Time k = 0; k < count; ++k, before += 2 * size(), now += 2 * size()) {
            const Time time = stamp[k] - latency;
            for (Time row = first_after(time - 1); row < end && rows[row].time == time; ++row)
                if (rows[row].source == source && rows[row].stamp == stamp[k]) amend(row, before, now);
        }
        run(target);
        port.end = end;
    }

  private:
    static constexpr Time SPARE = 16;  // one in so many places is for rows that have left and may be read

    // An event, what became of it, and the state before it.
    struct Row {
        Time time, stamp;
        int source;
        std::int16_t contradicts;
        std::vector<double> numbers;  // value, spread, innovation, its sd, noise scale
        std::vector<Code> codes;      // known and outcome
        State<N, double> before;
    };

    // Rows, counted from the first that ever came; of the latest there is a place for as many as a power of two.
    struct Ring {
        Time axes;
        mutable std::vector<Row> places;

        Ring(Time room, Time axes, const State<N, double>& state)
            : axes(axes),
              places(std::bit_ceil(std::uint64_t(std::max(room, 2 * SPARE * axes))),
                     {0, 0, 0, NOBODY, std::vector<double>(5 * axes), std::vector<Code>(2 * axes), state}) {}

        Time room() const { return Time(places.size()); }
        Row& at(Time row) const { return places[row & (room() - 1)]; }

        Event operator[](Time row) const {
            Row& entry = at(row);
            double* number = entry.numbers.data();
            return {entry.time, entry.stamp, entry.source, number, number + axes, entry.codes.data()};
        }

        Fate fate(Time row) const {
            Row& entry = at(row);
            double* number = entry.numbers.data() + 2 * axes;
            return {number, number + axes, number + 2 * axes, entry.codes.data() + axes, &entry.contradicts};
        }
    };

    Model<double> model;
    Filter<N> filter;
    State<N, double> state, trial;  // trial: for estimates
    Ring rows;
    Time most;                                      // rows, at the most
    Time begin = 0, end = 0, done = 0, target = 0;  // of rows: those in the state, and those that are to be
    Time behind = 0;                                // ns: how far a measurement may lie before its stamp, and a period
    std::vector<Time> first;                        // stamp of the first command of each axis
    std::vector<double> numbers;                    // of the port; innovations of the trial
    std::vector<Code> codes;                        // likewise

    Time size() const { return Time(model.axes.size()); }
    static Time nanoseconds(double seconds) { return std::llrint(seconds * 1e9); }
    Time delay(Time a) const { return nanoseconds(model.axes[a].delay); }

    // The axis rests at a level from the origin on.
    void rest(Time a, double level) {
        state.axes[a] = filter.at_rest(a, level, port.origin);
        state.gates[a].sensor.assign(model.sensors.size(), {}), state.gates[a].unsettled = PF_ALWAYS;
    }

    // Bring the state to before a row, if it is past it.
    void restore(Time row) {
        if (row < done) state = rows.at(row).before, done = row;
    }

    // Bring the state to where it is to be, at least to before a row.
    void run(Time row) {
        for (target = std::max(target, row); done < target; ++done) {
            rows.at(done).before = state;
            filter.step(state, rows[done], rows.fate(done));
        }
    }

    // Let go of events that nothing can change any more, and make room for `wanted` rows more: in more memory, or at
    // the limit by giving up the oldest eighth. False if an event of that stamp is then too late.
    bool has_room(Time wanted, Time stamp, Time oldest) {
        const Time horizon = oldest - behind;
        while (begin < done && rows[begin].time < horizon) ++begin;
        while (target < end && rows[target].time < horizon) ++target;
        while (end - begin + wanted > rows.room() - rows.room() / SPARE) {
            if (rows.room() < most) {
                Ring larger(2 * rows.room(), size(), state);
                for (Time row = std::max(end - rows.room(), Time(0)); row < end; ++row)
                    std::swap(larger.at(row), rows.at(row));
                std::swap(rows, larger);
            } else {
                const Time row = begin + rows.room() / 8;
                port.floor = rows[row].time + 1 + behind;
                run(row + 1);
                begin = row + 1;
            }
            if (stamp < port.floor) return false;
        }
        return true;
    }

    void add_measurement(Time stamp, int sensor, std::uint64_t bits) {
        const Time row = insert(stamp - nanoseconds(model.sensors[sensor].latency), sensor, stamp, bits);
        const bool duplicate = repeats_earlier(rows, row, begin, int(size()));
        for (Time a = 0; a < size(); ++a)
            port.outcome[a] = rows[row].known[a] = classify(row, a, duplicate ? PF_DUPLICATE : PF_FUSED);
        if (duplicate) return remove(row);
        run(row + 1);
        const Fate fate = rows.fate(row);
        port.contradicts = *fate.contradicts;
        std::copy_n(fate.outcome, size(), port.outcome);
        std::copy_n(fate.innovation, size(), port.innovation);
        std::copy_n(fate.innovation_sd, size(), port.innovation_sd);
    }

    // A row for each delay of the axes that a command moves.
    void add_command(Time stamp, std::uint64_t bits) {
        std::fill_n(port.outcome, size(), Code(PF_ABSENT));
        for (Time a = 0; a < size(); ++a) {
            if (!(bits >> a & 1)) continue;
            std::uint64_t together = 0;
            for (Time b = a; b < size(); ++b) together |= delay(b) == delay(a) ? bits & std::uint64_t(1) << b : 0;
            bits &= ~together;
            const Time time = stamp + delay(a), row = insert(time, PF_COMMAND, stamp, together);
            const bool duplicate = repeats_earlier(rows, row, begin, int(size()));
            if (duplicate) remove(row);
            for (Time b = a; b < size(); ++b) {
                if (!(together >> b & 1)) continue;
                if (!duplicate) reclassify(b, first_after(time - 1), time + Time(model.axes[b].period * 0.5e9));
                port.outcome[b] = duplicate ? Code(PF_DUPLICATE) : rows[row].known[b];
            }
        }
        for (Time a = 0; a < size(); ++a)
            if (port.outcome[a] == PF_FUSED && stamp <= first[a]) start_axis(a, stamp);
    }

    // Let an axis rest until its first command, which is that of `stamp`; all of them if none was before it.
    void start_axis(Time a, Time stamp) {
        const bool earlier = stamp < port.origin;
        first[a] = stamp, port.origin = std::min(stamp, port.origin);
        restore(begin);
        for (Time b = 0; b < size(); ++b) {
            double level = model.axes[b].start;
            if (!earlier && (b != a || !std::isnan(level))) continue;  // where it rested was known before
            if (std::isnan(level)) {
                if (b != a) level = state.axes[b].response.start;
                for (Time row = begin; row < end; ++row)
                    if (rows[row].commands(b) && rows[row].stamp == first[b]) level = rows[row].value[b];
            }
            rest(b, level);
            reclassify(b, begin, PF_NEVER);
        }
    }

    Code classify(Time row, Time a, Code whole) const {
        return Policy{model, port.origin}.classify(rows, row, int(a), begin, end, whole, state.axes[a].response.start);
    }

    // Look again at the values of an axis from a row on that are not after `until`.
    void reclassify(Time a, Time row, Time until) {
        for (; row < end && rows[row].time <= until; ++row) {
            const Code now = classify(row, a, PF_FUSED);
            if (now != std::exchange(rows[row].known[a], now)) restore(row);
        }
    }

    // Insert a row with the axes of the port that are in `bits`: by time, then source, then stamp; of equals the new
    // one is the last. Returns the row.
    Time insert(Time time, int source, Time stamp, std::uint64_t bits) {
        Time row = end;
        for (; row > begin; --row) {
            const Event other = rows[row - 1];
            if (std::tie(other.time, other.source, other.stamp) <= std::tie(time, source, stamp)) break;
        }
        restore(row);
        for (Time k = end++; k > row; --k) std::swap(rows.at(k), rows.at(k - 1));
        target += row < target;
        Row& entry = rows.at(row);
        entry.time = time, entry.stamp = stamp, entry.source = source;
        std::copy_n(numbers.begin(), 2 * size(), entry.numbers.begin());
        for (Time a = 0; a < size(); ++a) entry.codes[a] = bits >> a & 1 ? PF_FUSED : PF_ABSENT;
        return row;
    }

    // Values and spreads of a row that are as they were `before` are those of `now`.
    void amend(Time row, const double* before, const double* now) {
        double* number = rows.at(row).numbers.data();
        for (Time a = 0; a < size(); ++a) {
            const bool alike = number[a] == before[a] || (std::isnan(number[a]) && std::isnan(before[a]));
            if (rows[row].known[a] == PF_ABSENT || !alike || now[a] == before[a]) continue;
            restore(row);
            number[a] = now[a], number[size() + a] = now[size() + a];
            rows[row].known[a] = classify(row, a, PF_FUSED);
        }
    }

    void remove(Time row) {
        for (--end, target -= row < target; row < end; ++row) std::swap(rows.at(row), rows.at(row + 1));
    }

    Time first_after(Time time) const {
        const auto window = std::views::iota(begin, end);
        return *std::ranges::partition_point(window, [&](Time row) { return rows[row].time <= time; });
    }
};

}  // namespace pumafuse
