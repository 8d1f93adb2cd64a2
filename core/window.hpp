// The last seconds of a stream: rows of events as of a recording, with a checkpoint before each of them.
//
// A new event is put where its time says; the filter goes back to the checkpoint there and runs on, by the pass that
// fuses a recorded run. Commands that act later than the newest measurement wait until one comes after them.
#pragma once
#include "counters.hpp"
#include "filter.hpp"

namespace pumafuse {

// Rows of events and what became of them, counted from the first that ever came; the latest `room` of them are kept.
class Ring {
  public:
    Time room, axes;

    Ring(Time room, Time axes)  // room: a power of two
        : room(room), axes(axes), heads(room), numbers(room * 4 * axes), codes(room * 2 * axes) {}

    Time place(Time row) const { return row & (room - 1); }

    Event operator[](Time row) const {
        const Head& head = heads[place(row)];
        double* number = &numbers[place(row) * 4 * axes];
        return {head.time, head.stamp, head.source, number, number + axes, &codes[place(row) * 2 * axes]};
    }

    Fate fate(Time row) const {
        double* number = &numbers[place(row) * 4 * axes];
        Code* code = &codes[place(row) * 2 * axes];
        return {number + 2 * axes, number + 3 * axes, code + axes, &heads[place(row)].contradicts};
    }

    void put(Time row, const Event& event) {
        heads[place(row)] = {event.time, event.stamp, event.source, NOBODY};
        std::copy_n(event.value, axes, &numbers[place(row) * 4 * axes]);
        std::copy_n(event.spread, axes, &numbers[place(row) * 4 * axes] + axes);
        std::copy_n(event.known, axes, &codes[place(row) * 2 * axes]);
    }

    void copy(Time row, const Ring& from, Time there) {
        heads[place(row)] = from.heads[from.place(there)];
        std::copy_n(&from.numbers[from.place(there) * 4 * axes], 4 * axes, &numbers[place(row) * 4 * axes]);
        std::copy_n(&from.codes[from.place(there) * 2 * axes], 2 * axes, &codes[place(row) * 2 * axes]);
    }

  private:
    struct Head {
        Time time, stamp;
        int source;
        std::int16_t contradicts;
    };
    mutable std::vector<Head> heads;
    mutable std::vector<double> numbers;  // of each row value, spread, innovation and its sd
    mutable std::vector<Code> codes;      // known and outcome
};

template <int N>
class Window {
  public:
    pf_port port;

    Window(const pf_model& given, const Model<double>& model, Time first_room, Time most, const Counters& carried)
        : axis(given.axis, given.axis + given.axes), sensor(given.sensor, given.sensor + given.sensors),
          view(given.view, given.view + given.axes * given.sensors), filter(model), state(filter.at_rest(0)),
          aside(state), rows(rounded(std::max(first_room, given.axes)), given.axes), checkpoints(rows.room, state),
          most(most),
          first(given.axes, PF_NEVER), value(given.axes), spread(given.axes, 1.0), found(3 * given.axes),
          outcome(2 * given.axes), counters(carried) {
        Time period = 0;
        for (const pf_axis& one : axis)
            delay.push_back(std::llrint(one.delay * 1e9)), period = std::max(period, Time(one.period * 1e9));
        for (const pf_sensor& one : sensor)
            latency.push_back(std::llrint(one.latency * 1e9)), behind = std::max(behind, latency.back());
        behind += period;
        port = {value.data(), spread.data(), outcome.data(), found.data(), NOBODY, PF_NEVER, PF_ALWAYS, rows.room, 0};
    }

    bool measurement(Time stamp, int from, std::uint64_t given, Time newest, Time oldest) {
        if (!has_room(1, stamp, oldest)) return false;
        const Time row = put_measurement(stamp, from, given);
        run(row);
        for (Time a = 0; a < size() && row < 0; ++a)  // it repeats another
            if (outcome[a] != PF_ABSENT) ++counters.count(from, outcome[a]);
        counters.came(from, stamp, newest);
        count_what_left();
        return true;
    }

    bool command(Time stamp, std::uint64_t given, Time oldest) {
        if (!has_room(size(), stamp, oldest)) return false;
        put_command(stamp, given);
        run();
        count_what_left();
        return true;
    }

    void estimate(Time time, Time after, double* outputs, Time* fused) {
        if (port.origin == PF_NEVER) {
            std::fill_n(outputs, PF_OUTPUTS * size(), std::nan("")), std::fill_n(fused, size(), PF_NEVER);
            return;
        }
        time = std::max(time, port.origin);
        Time hidden = after == PF_NEVER ? done : begin;
        while (hidden < done && rows[hidden].stamp <= after) ++hidden;
        const Time until = first_after(time), stamped = std::min(time, after);
        Time row = std::min({hidden, done, until});
        aside = row < done ? checkpoints[rows.place(row)] : state;
        for (; row < until; ++row)  // what is valid by then, without what is hidden
            if (rows[row].stamp <= (row < done ? after : stamped)) filter.step(aside, rows[row], scratch());
        filter.estimate(aside, rows, until, end, time, stamped, outputs);
        for (Time a = 0; a < size(); ++a) {
            outputs[a] += aside.axes[a].response.start;  // positions come first
            fused[a] = port.origin;
            for (int s = 0; s < int(sensor.size()); ++s)
                fused[a] = std::max(fused[a], aside.gates[a * sensor.size() + s].fused_at);
        }
    }

    void commands(Time until, Time* stamp, double* value, double* step) const {
        for (Time a = 0; a < size(); ++a) {
            const auto before = [&](Time row) {
                for (--row; row >= begin && !(rows[row].commands(a) && rows[row].stamp <= until);) --row;
                return row;
            };
            const Response<double>& r = (begin < done ? checkpoints[rows.place(begin)] : state).axes[a].response;
            const double left = r.start + r.u;  // the last of those that have left the window
            const Time last = before(end), previous = last < begin ? last : before(last);
            stamp[a] = first[a] == PF_NEVER ? PF_NEVER : last < begin ? PF_ALWAYS : rows[last].stamp;
            value[a] = last < begin ? left : rows[last].value[a];
            step[a] = previous >= begin ? value[a] - rows[previous].value[a] : last < begin ? r.step : value[a] - left;
        }
    }

    void forget(Time after) {
        counters.forget(after);
        const Ring before = rows;
        const Time stop = end;
        restore(begin);
        end = done = target = begin;
        if (port.origin > after) port.origin = PF_NEVER;
        for (Time a = 0; a < size(); ++a)
            if (first[a] > after && first[a] < PF_NEVER) first[a] = PF_NEVER, rest(a, axis[a].start);  // just begun
        const std::vector<Time> begun = first;
        for (Time& one : first) one = one < PF_NEVER ? PF_ALWAYS : one;  // what left the window since then stays
        for (Time row = begin; row < stop; ++row) {
            const Event event = before[row];
            std::uint64_t given = 0;
            for (Time a = 0; a < size(); ++a) given |= std::uint64_t(event.known[a] != PF_ABSENT) << a;
            if (event.stamp > after) {
                if (!event.is_command()) counters.count(event.source, PF_INVALID) += std::popcount(given);
                continue;
            }
            std::copy_n(event.value, size(), value.begin()), std::copy_n(event.spread, size(), spread.begin());
            if (event.is_command()) {
                put_command(event.stamp, given);
            } else {
                put_measurement(event.stamp, event.source, given);
                counters.last[event.source] = std::max(counters.last[event.source], event.stamp);
            }
        }
        run();
        for (Time a = 0; a < size(); ++a) first[a] = begun[a] < PF_NEVER ? begun[a] : first[a];
        std::fill(spread.begin(), spread.end(), 1.0);
    }

    void count_late(int from, Time stamp, Time newest, Time times) {
        times > 0 ? counters.came(from, stamp, newest) : void(--counters.count(from, PF_CAME));
    }

    Counters counted() const {
        Counters now = counters;
        for (Time row = left; row < end; ++row) now.leaves(rows[row], rows.fate(row), size());
        return now;
    }

  private:
    std::vector<pf_axis> axis;
    std::vector<pf_sensor> sensor;
    std::vector<pf_view> view;
    Filter<N> filter;
    State<N, double> state, aside;              // aside: for estimates
    Ring rows;
    std::vector<State<N, double>> checkpoints;  // before each row
    Time most;                                  // rows, at the most
    Time begin = 0, end = 0, done = 0, target = 0, left = 0;  // of rows: those in the state, those to be, those counted
    Time behind = 0;                            // ns: how far a measurement may lie before its stamp, and a period
    std::vector<Time> first, delay, latency;    // stamp of the first command of each axis; ns
    std::vector<double> value, spread, found;   // found: of the last event, and of what is tried aside
    std::vector<Code> outcome;                  // likewise
    std::int16_t nobody = NOBODY;
    Counters counters;

    Time size() const { return Time(axis.size()); }
    Fate scratch() { return {&found[size()], &found[2 * size()], &outcome[size()], &nobody}; }
    static Time rounded(Time room) { return Time(std::bit_ceil(std::uint64_t(std::max(room, Time(2))))); }

    void rest(Time a, double level) {
        state.axes[a] = filter.at_rest(a, level, port.origin);
        std::fill_n(state.gates.begin() + a * sensor.size(), sensor.size(), Gate{});
    }

    // Bring the state to before a row, if it is past it.
    void restore(Time row) {
        if (row < done) state = checkpoints[rows.place(row)], done = row;
    }

    // Bring the state to where it is to be, and tell what became of a measurement in `row`.
    void run(Time row = -1) {
        for (; done < target; ++done) {
            checkpoints[rows.place(done)] = state;
            filter.step(state, rows[done], rows.fate(done));
        }
        port.contradicts = NOBODY, port.room = rows.room, port.held = end - begin;
        if (row < 0) return;
        const Fate fate = rows.fate(row);
        std::copy_n(fate.outcome, size(), outcome.begin()), std::copy_n(fate.innovation, size(), found.begin());
        port.contradicts = *fate.contradicts;
    }

    void count_what_left() {
        for (; left < begin; ++left) counters.leaves(rows[left], rows.fate(left), size());
    }

    // Let go of events that nothing can change any more, and make room for `wanted` rows more: in more memory, or at
    // the limit by giving up the oldest eighth. False if an event of that stamp is then too late.
    bool has_room(Time wanted, Time stamp, Time oldest) {
        const Time horizon = oldest - behind;
        while (begin < done && rows[begin].time < horizon) ++begin;
        while (target < end && rows[target].time < horizon) ++target;
        count_what_left();
        while (end - begin + wanted > rows.room) {
            if (rows.room < most) {
                grow();
            } else {
                const Time row = begin + rows.room / 8;
                port.floor = rows[row].time + 1 + behind, target = std::max(target, row + 1);
                run();
                begin = row + 1;
                count_what_left();
            }
            if (stamp < port.floor) return false;
        }
        return true;
    }

    void grow() {
        Ring larger(2 * rows.room, size());
        std::vector<State<N, double>> places(larger.room, state);
        for (Time row = begin; row < end; ++row) {
            larger.copy(row, rows, row);
            places[larger.place(row)] = checkpoints[rows.place(row)];
        }
        rows = std::move(larger), checkpoints = std::move(places);
    }

    // The row of a measurement, which is to be run then; -1 if its stamp and values are those of one before.
    Time put_measurement(Time stamp, int from, std::uint64_t given) {
        const Time row = insert(stamp - latency[from], from, stamp, given);
        const bool duplicate = repeats_earlier(rows, row, begin, int(size()));
        for (Time a = 0; a < size(); ++a)
            outcome[a] = rows[row].known[a] = classified(row, a, duplicate ? PF_DUPLICATE : PF_FUSED);
        if (duplicate) return remove(row), -1;
        target = std::max(target, row + 1);
        return row;
    }

    // A row for each delay of the axes that a command moves.
    void put_command(Time stamp, std::uint64_t given) {
        std::fill_n(outcome.begin(), size(), Code(PF_ABSENT));
        for (Time a = 0; a < size(); ++a) {
            if (!(given >> a & 1)) continue;
            std::uint64_t together = 0;
            for (Time b = a; b < size(); ++b) together |= (delay[b] == delay[a] ? given >> b & 1 : 0) << b;
            given &= ~together;
            const Time time = stamp + delay[a], row = insert(time, PF_COMMAND, stamp, together);
            const bool duplicate = repeats_earlier(rows, row, begin, int(size()));
            if (duplicate) remove(row);
            for (Time b = a; b < size(); ++b) {
                if (!(together >> b & 1)) continue;
                if (!duplicate) reclassify(b, first_after(time - 1), time + Time(axis[b].period * 0.5e9));
                outcome[b] = duplicate ? Code(PF_DUPLICATE) : rows[row].known[b];
            }
        }
        for (Time a = 0; a < size(); ++a)
            if (outcome[a] == PF_FUSED && stamp <= first[a]) begin_axis(a, stamp);
    }

    // Let an axis rest until its first command, which is that of `stamp`; all of them if none was before it.
    void begin_axis(Time a, Time stamp) {
        const bool earlier = stamp < port.origin;
        first[a] = stamp, port.origin = std::min(stamp, port.origin);
        restore(begin);
        for (Time b = 0; b < size(); ++b) {
            double level = axis[b].start;
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

    Code classified(Time row, Time a, Code whole) const {
        const pf_model known{size(), Time(sensor.size()), axis.data(), sensor.data(), view.data()};
        return Policy{known, port.origin}.classify(rows, row, int(a), begin, end, whole, state.axes[a].response.start);
    }

    // Look again at the values of an axis from a row on that are not after `until`.
    void reclassify(Time a, Time row, Time until) {
        for (; row < end && rows[row].time <= until; ++row) {
            Code& known = rows[row].known[a];
            const Code now = classified(row, a, PF_FUSED);
            if (now != known) restore(row), known = now;
        }
    }

    // Put the axes of the port that are bits of `given` in their place: by time, then source, then stamp; of those
    // alike the new one is the last. Returns the row.
    Time insert(Time time, int source, Time stamp, std::uint64_t given) {
        Time at = end;
        for (; at > begin; --at) {
            const Event other = rows[at - 1];
            if (std::tie(other.time, other.source, other.stamp) <= std::tie(time, source, stamp)) break;
        }
        restore(at);
        for (Time row = end; row > at; --row) rows.copy(row, rows, row - 1);
        ++end, target += at < target;
        Code* known = &outcome[size()];
        for (Time a = 0; a < size(); ++a) known[a] = given >> a & 1 ? PF_FUSED : PF_ABSENT;
        rows.put(at, {time, stamp, source, value.data(), spread.data(), known});
        return at;
    }

    void remove(Time row) {
        for (--end, target -= row < target; row < end; ++row) rows.copy(row, rows, row + 1);
    }

    Time first_after(Time time) const {
        Time low = begin, high = end;
        while (low < high) {
            const Time middle = low + (high - low) / 2;
            (rows[middle].time <= time ? low : high) = rows[middle].time <= time ? middle + 1 : middle;
        }
        return low;
    }
};

}  // namespace pumafuse
