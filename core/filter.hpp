// The filter: one pass over events in their order. A measurement tells of r + xi; the commands move r alone.
#pragma once
#include <algorithm>
#include <limits>
#include <numeric>

#include "events.hpp"
#include "gate.hpp"
#include "residual.hpp"
#include "response.hpp"

namespace pumafuse {

// Where one axis is.
template <int N, class Real>
struct AxisState {
    Response<Real> response;
    Residual<N, Real> residual;
};

// What changes: a copy of it is a checkpoint.
template <int N, class Real>
struct State {
    std::vector<AxisState<N, Real>> axes;
    std::vector<Gates> gates;
};

// A standard deviation. It is never 0, whatever a model without noise says: no arm, sensor or log resolves less.
inline double error_bar(double variance) { return std::max(std::sqrt(variance), PF_FINEST); }

// What is known of one axis.
template <int N, class Real>
struct AxisModel {
    Arm<Real> arm;
    Noise<N, Real> noise;
    Time ahead;              // T [ns]
    Vector<N, Real> motion;  // over the period ahead
    Real delayed;            // what the delay's derivatives make of an instant
    double start;
    ByDoubt<> sd;            // of the lag [s] and of the gain
    double unseen;           // sd of the lag where no measurement tells [s]

    explicit AxisModel(const Axis<Real>& axis)
        : arm(axis), noise(axis), ahead(std::llrint(arm.period * 1e9)),
          motion(noise.motion(arm.plant, double(ahead) / 1e9)), delayed(axis.delay - value_of(axis.delay)),
          start(value_of(axis.start)), sd{value_of(axis.lag_sd), value_of(axis.gain_sd)},
          unseen(value_of(axis.unseen_lag_sd)) {}

    // What lag and gain add to the variance of what changes so with them.
    double variance(const ByDoubt<>& by) const { return square(by[LAG] * sd[LAG]) + square(by[GAIN] * sd[GAIN]); }

    // The error bar of a state.
    double sd_of(const Residual<N, Real>& xi, int i) const {
        return error_bar(std::max(value_of(xi.P[i][i]), 0.0) + variance({xi.dx[LAG][i], xi.dx[GAIN][i]}));
    }

    // Widen the error bar of a position by the lag that no measurement sees; the response goes `way` [m] in a period.
    void widen(double way, double (&numbers)[PF_OUTPUTS]) const {
        double& sd = numbers[PF_POSITION_SD];
        if (unseen > 0.0) sd = std::sqrt(square(sd) + square(unseen * way / arm.period));
    }

    // How the response changes with lag and gain, where these are doubted.
    ByDoubt<> doubt(const Response<Real>& response) const {
        return noise.doubted ? response.by_doubt(arm) : ByDoubt<>{};
    }
};

// What the smoother needs to know of an update by `sensor`, or of a change of noise, which is of none.
template <int N>
struct Entry {
    Time time;
    double q, drift, scale;  // in force until then
    int sensor = NOBODY;
    double nu = 0.0, R = 0.0, widened = 0.0;
    ByDoubt<> d_nu{};
    Vector<N, double> K{};
};

// An innovation and its S; with derivatives likelihood.hpp stores more.
inline void store(const Fate& fate, Time axis, double nu, double S) {
    fate.innovation[axis] = nu, fate.innovation_sd[axis] = std::sqrt(S);
}

template <int N, class Real = double>
class Filter {
  public:
    using History = std::vector<std::vector<Entry<N>>>;  // of each axis, by time
    std::vector<AxisModel<N, Real>> axes;
    std::vector<Sensor<Real>> sensors;
    std::vector<View<Real>> views;   // (S, A)
    std::vector<Vector<N, Real>> H;  // of each sensor on each axis, (S, A)
    std::vector<int> bias;           // which state is the constant bias of each, -1 for none, (S, A)

    explicit Filter(const Model<Real>& model)
        : axes(model.axes.begin(), model.axes.end()), sensors(model.sensors), views(model.views),
          bias(model.views.size(), -1), innovations(axes.size()) {
        for (Time at = 0; at < Time(views.size()); ++at) {
            const View<Real>& view = views[at];
            Noise<N, Real>& noise = axes[at % size()].noise;
            Vector<N, Real> h{};
            for (int i = 0; i < N; ++i) h[i] = sensors[at / size()].scale * noise.position[i];
            const bool drifts = value_of(view.bias_drift_sd) > 0.0;
            if (drifts) h[noise.add(1.0 / view.bias_time, square(view.bias_drift_sd))] = 1.0;
            if (value_of(view.bias_sd) > 0.0) h[bias[at] = noise.add(0.0, square(view.bias_sd))] = 1.0;
            H.push_back(h);
        }
    }

    Time size() const { return Time(axes.size()); }

    AxisState<N, Real> at_rest(Time a, double start, Time origin) const {
        AxisState<N, Real> state;
        state.response.time.ns = origin, state.response.start = start;
        state.residual = Residual<N, Real>(axes[a].noise, state.response.time);
        return state;
    }

    State<N, Real> at_rest(Time origin) const {
        State<N, Real> state;
        for (Time a = 0; a < size(); ++a) state.axes.push_back(at_rest(a, axes[a].start, origin));
        state.gates.assign(size(), {std::vector<Gate>(sensors.size())});
        return state;
    }

    // One event: a command of some axes, or a measurement. `repeat`: its outcomes stay as they are.
    void step(State<N, Real>& state, const Event& event, const Fate& fate, bool repeat = false,
              History* history = nullptr) const {
        *fate.contradicts = NOBODY;
        const Time together = !event.is_command() && value_of(sensors[event.source].gate_rows) != 0.0 ? size() : 1;
        for (Time a = 0; a < size(); a += together) {
            if (!event.is_command()) measurement(state, event, a, a + together, fate, repeat, history);
            else if (event.commands(a)) command(state.axes[a], a, event, history);
        }
    }

    // Every axis at an instant, as estimate n of `count`; of rows from `pending` on, which are not in the state yet,
    // the commands count that act by then and are stamped by `stamped`.
    template <class Rows>
    void estimate(const State<N, Real>& state, const Rows& rows, Time pending, Time end, Time time, Time stamped,
                  double* outputs, Time count = 1, Time n = 0) const {
        for (Time a = 0; a < size(); ++a) {
            const AxisModel<N, Real>& axis = axes[a];
            AxisState<N, Real> now = state.axes[a];
            const Time next = predict_by_commands(now, a, rows, pending, end, time, stamped);
            double numbers[PF_OUTPUTS];
            const double r = now.response.position(axis.arm);
            const ByDoubt<> left = describe(axis, r, axis.doubt(now.response), now.residual, numbers);
            const double moving = now.residual.variance(axis.motion);
            now.residual.P = {};  // what comes is noise alone
            predict_by_commands(now, a, rows, next, end, time + axis.ahead, stamped);
            const double r_later = now.response.position(axis.arm);
            axis.widen(r_later - r, numbers);
            const double later = r_later + now.residual.mean(axis.noise.position);
            numbers[PF_VELOCITY] = (later - numbers[PF_POSITION]) / axis.arm.period;
            const ByDoubt<> then = now.residual.error_by_doubt(axis.doubt(now.response), 1.0, axis.noise.position);
            const double doubted = axis.variance({then[LAG] - left[LAG], then[GAIN] - left[GAIN]});
            const double variance = moving + now.residual.variance(axis.noise.position) + doubted;
            numbers[PF_VELOCITY_SD] = error_bar(variance) / axis.arm.period;
            for (int k = 0; k < PF_OUTPUTS; ++k) outputs[(k * size() + a) * count + n] = numbers[k];
        }
    }

    // Position, offset and disturbance of an axis whose response is at r; no velocity. Returns how what is not known of
    // the position changes with lag and gain, as the response does by `doubt`.
    static ByDoubt<> describe(const AxisModel<N, Real>& axis, double r, const ByDoubt<>& doubt,
                              const Residual<N, double>& xi, double (&numbers)[PF_OUTPUTS]) {
        const ByDoubt<> left = xi.error_by_doubt(doubt, 1.0, axis.noise.position);
        const bool disturbed = axis.noise.smoothness != Smoothness::none;
        numbers[PF_POSITION] = r + xi.mean(axis.noise.position);
        numbers[PF_POSITION_SD] = error_bar(xi.variance(axis.noise.position) + axis.variance(left));
        numbers[PF_VELOCITY] = numbers[PF_VELOCITY_SD] = std::numeric_limits<double>::quiet_NaN();
        numbers[PF_OFFSET] = xi.x[OFFSET], numbers[PF_OFFSET_SD] = axis.sd_of(xi, OFFSET);
        numbers[PF_DISTURBANCE] = disturbed ? xi.x[DISTURBANCE] : 0.0;
        numbers[PF_DISTURBANCE_SD] = disturbed ? axis.sd_of(xi, DISTURBANCE) : 0.0;
        return left;
    }

    // How far the response of axis `a` goes over the coming period [m]; rows from `next` on are not in it yet.
    template <class Rows>
    double way_ahead(AxisState<N, Real> now, Time a, const Rows& rows, Time next, Time end, Time time) const {
        const double r = now.response.position(axes[a].arm);
        predict_by_commands(now, a, rows, next, end, time + axes[a].ahead, time);
        return now.response.position(axes[a].arm) - r;
    }

    // Response and residual to an instant.
    void predict(AxisState<N, Real>& state, Time a, const Instant<Real>& to) const {
        state.residual.predict(axes[a].arm.plant, axes[a].noise, to);
        state.response.predict(axes[a].arm, to);
    }

  private:
    struct Innovation {
        Real nu, R;
        ByDoubt<> d_nu;
        Projection<N, Real> projection;
    };
    // Innovations of the row at hand, whose axes pass the gate together: each is computed once.
    mutable std::vector<Innovation> innovations;

    // nu = z - H x and S = H P H^T + R here and now; of an angle that is measured within a turn the nearest nu.
    Innovation innovation(const AxisState<N, Real>& state, const Event& event, Time a) const {
        const Time at = event.source * size() + a;
        const Residual<N, Real>& xi = state.residual;
        const Real R = noise_of(state, event, a), scale = sensors[event.source].scale;
        const Real r = state.response.position(axes[a].arm);
        const Real expected = scale * state.response.start + scale * r + xi.mean(H[at]);
        return {nearest(event.value[a] - expected, value_of(views[at].turn)), R,
                xi.error_by_doubt(axes[a].doubt(state.response), value_of(scale), H[at]), {xi.P, H[at], R}};
    }

    // R = (spread sd)^2 + (scale speed latency_sd)^2 [m^2] here and now.
    Real noise_of(const AxisState<N, Real>& state, const Event& event, Time a) const {
        const Sensor<Real>& sensor = sensors[event.source];
        const Real sd = views[event.source * size() + a].sd * (event.spread ? event.spread[a] : 1.0);
        if (value_of(sensor.latency_sd) == 0.0) return square(sd);
        const Arm<Real>& arm = axes[a].arm;
        const Noise<N, Real>& noise = axes[a].noise;
        const Vector<N, Real>& x = state.residual.x;  // the speed is C (A x + B (u + e)) of response and residual
        Real speed = state.response.speed(arm) + (arm.plant.order == 1 ? -arm.plant.rate * x[PLANT] : x[RATE]);
        if (noise.smooth()) speed = speed + x[DISTURBANCE + 1];
        return square(sd) + square(sensor.scale * speed * sensor.latency_sd);
    }

    // x <- x + K nu and P in Joseph's form; a measurement that re-acquires widens the offset first.
    void update(State<N, Real>& state, const Event& event, Time a, const Fate& fate, History* history) const {
        Residual<N, Real>& xi = state.axes[a].residual;
        auto [nu, R, d_nu, projection] = innovations[a];
        const Vector<N, Real>& h = H[event.source * size() + a];
        Real widened = 0.0;
        if (fate.outcome[a] == PF_REACQUIRED) {  // the offset may have moved by nu
            widened = square(nu / sensors[event.source].scale);
            xi.P[OFFSET][OFFSET] = xi.P[OFFSET][OFFSET] + widened;
            state.gates[a].reacquire(event.source, event.time);
            projection = {xi.P, h, R};
            store(fate, a, nu, projection.S);
        }
        const Vector<N, Real> K = xi.update(h, projection, nu, d_nu, R);
        state.gates[a].fuse(event.source, event.time);
        if constexpr (std::is_same_v<Real, double>)
            if (history)
                (*history)[a].push_back(
                    {event.time, xi.input(), xi.drifting(), xi.scale, event.source, nu, R, widened, d_nu, K});
        if (fate.outcome[a] != PF_REACQUIRED) xi.learn(axes[a].noise, nu, projection.S, R);
    }

    // The response takes the command; the residual only its noise, where that grows with maneuvers.
    void command(AxisState<N, Real>& state, Time a, const Event& event, History* history) const {
        const AxisModel<N, Real>& axis = axes[a];
        const Instant<Real> acts{event.time, axis.delayed};
        Residual<N, Real>& xi = state.residual;
        if (axis.noise.maneuvers) xi.accumulate(axis.arm.plant, acts);
        state.response.predict(axis.arm, acts);
        const double maneuver = state.response.command(axis.arm, event.value[a]);
        if (!axis.noise.maneuvers) return;  // then commands change nothing of the residual
        if (history)
            (*history)[a].push_back({event.time, value_of(xi.input()), value_of(xi.drifting()), value_of(xi.scale)});
        xi.set_noise(axis.noise, maneuver);
    }

    // Axes first to end of one row, which pass the gate together or not at all.
    void measurement(State<N, Real>& state, const Event& event, Time first, Time end, const Fate& fate, bool repeat,
                     History* history) const {
        const Sensor<Real>& sensor = sensors[event.source];
        const double gate = value_of(sensor.gate);
        const auto far = [&](Time a) { return std::fabs(fate.innovation[a]) > gate * fate.innovation_sd[a]; };
        bool beyond = false;
        for (Time a = first; a < end; ++a) {
            if (!repeat) fate.outcome[a] = event.known[a];
            if (event.known[a] != PF_FUSED) continue;
            predict(state.axes[a], a, {event.time, value_of(sensor.latency) - sensor.latency});
            const Innovation& now = innovations[a] = innovation(state.axes[a], event, a);
            store(fate, a, now.nu, now.projection.S), fate.noise_scale[a] = value_of(state.axes[a].residual.scale);
            beyond |= gate > 0.0 && far(a);
        }
        const bool reacquires = beyond && !repeat && this->reacquires(state, event, first, end, fate);
        for (Time a = first; a < end; ++a) {
            if (event.known[a] != PF_FUSED) continue;
            if (beyond && !repeat) fate.outcome[a] = !reacquires ? PF_REJECTED : far(a) ? PF_REACQUIRED : PF_FUSED;
            if (fate.outcome[a] != PF_REJECTED) update(state, event, a, fate, history);
        }
    }

    // Whether a row beyond its gate re-acquires; if not, it is remembered, and whom it contradicts noted.
    bool reacquires(State<N, Real>& state, const Event& event, Time first, Time end, const Fate& fate) const {
        const double gate = value_of(sensors[event.source].gate);
        bool all_agree = true, too_soon = false;
        int other = NOBODY;
        for (Time a = first; a < end; ++a) {
            if (event.known[a] != PF_FUSED || !(std::fabs(fate.innovation[a]) > gate * fate.innovation_sd[a])) continue;
            const Agreement agreed = agreement(state, event, a, fate.innovation[a]);
            all_agree &= agreed == Agreement::yes, too_soon |= agreed == Agreement::too_soon;
            other = std::max(other, state.gates[a].contradicted(event.source, event.time));
        }
        if (all_agree && other == NOBODY) return true;
        if (all_agree) *fate.contradicts = std::int16_t(other);
        for (Time a = first; a < end; ++a) {
            if (event.known[a] != PF_FUSED) continue;
            state.gates[a].reject(event.source, fate.innovation[a], value_of(innovations[a].R), event.time, too_soon);
        }
        return false;
    }

    // Whether a rejected measurement agrees with the one before: |nu2 - nu1| <= gate sqrt(R1 + R2 + the variance of the
    // motion between), both predicted by what did not follow them.
    Agreement agreement(State<N, Real>& state, const Event& event, Time a, double nu) const {
        const AxisModel<N, Real>& axis = axes[a];
        const Sensor<Real>& sensor = sensors[event.source];
        const Gate& before = state.gates[a].sensor[event.source];
        const Residual<N, Real>& xi = state.axes[a].residual;
        if (before.in_a_row == 0) return Agreement::no;  // rejected_at is no instant then
        const Time between = event.time - before.rejected_at;
        if (double(between) < axis.arm.period * 1e9) return Agreement::too_soon;
        Residual<N, Real> moved;  // from what is known, by noise alone
        moved.q = xi.q, moved.drift = xi.drift, moved.scale = xi.scale;
        moved.predict(axis.arm.plant, axis.noise, {between, 0.0});
        const Real motion =
            xi.variance(axis.noise.motion(axis.arm.plant, double(between) / 1e9)) + moved.variance(axis.noise.position);
        const double variance = value_of(before.R + innovations[a].R + square(sensor.scale) * motion);
        const double apart = nearest(nu - before.nu, value_of(views[event.source * size() + a].turn));
        return std::fabs(apart) <= value_of(sensor.gate) * std::sqrt(variance) ? Agreement::yes : Agreement::no;
    }

    // Predict to `until` by the commands from row `next` on that act by then and are stamped by `stamped`. Returns the
    // row after them.
    template <class Rows>
    Time predict_by_commands(AxisState<N, Real>& state, Time a, const Rows& rows, Time next, Time end, Time until,
                             Time stamped) const {
        for (; next < end && rows[next].time <= until; ++next) {
            const Event event = rows[next];
            if (event.commands(a) && event.stamp <= stamped) command(state, a, event, nullptr);
        }
        predict(state, a, {until, 0.0});
        return next;
    }
};

// Events begin to end, and an estimate at each of n times by the events until then.
template <int N>
void run(const Filter<N>& filter, State<N, double>& state, const Table& rows, Time begin, Time end, bool repeat, Time n,
         const Time* times, double* outputs) {
    for (Time k = 0; k <= n; ++k) {
        const Time until = k < n ? times[k] : PF_NEVER;
        for (; begin < end && rows.events.time[begin] <= until; ++begin)
            filter.step(state, rows[begin], rows.fate(begin), repeat);
        if (k < n) filter.estimate(state, rows, begin, rows.events.count, until, until, outputs, n, k);
    }
}

// Rows of which those that came after an instant are not yet stamped.
struct Arrived {
    const Table& rows;
    const Time* arrival;
    Time until;

    Event operator[](Time row) const {
        Event event = rows[row];
        if (arrival[row] > until) event.stamp = PF_NEVER;
        return event;
    }
};

// The same, each estimate by the events that had arrived when it was asked for: in the order of asking, and where an
// event comes late, or an earlier instant is asked for, the pass goes back to the checkpoint before it.
template <int N>
void run_as_live(const Filter<N>& filter, State<N, double>& state, const Table& rows, Time n, const Time* times,
                 const Time* asked, double* outputs) {
    const pf_events& events = rows.events;
    const Time count = events.count, *arrival = events.arrival ? events.arrival : events.stamp;
    const auto by = [](Time size, const Time* key) {
        std::vector<Time> order(size);
        std::iota(order.begin(), order.end(), Time(0));
        std::stable_sort(order.begin(), order.end(), [&](Time a, Time b) { return key[a] < key[b]; });
        return order;
    };
    const std::vector<Time> queue = by(count, arrival), turn = by(n, asked);
    // Rows by each estimate, and from where on they run anew.
    std::vector<Time> valid(n + 1, count), back(n + 1, count);
    Time places = 1;  // more than rows may have to be taken back
    for (Time k = 0, due = 0, reached = 0; k <= n; ++k) {
        if (k < n) valid[k] = std::upper_bound(events.time, events.time + count, times[turn[k]]) - events.time;
        back[k] = valid[k];
        for (; due < count && (k == n || arrival[queue[due]] <= asked[turn[k]]); ++due)
            back[k] = std::min(back[k], queue[due]);
        places = std::max(places, reached - back[k] + 1), reached = std::max(reached, valid[k]);
    }
    std::vector<State<N, double>> checkpoints(places, state);
    for (Time k = 0, done = 0; k <= n; ++k) {
        const Time until = k < n ? asked[turn[k]] : PF_NEVER;
        if (back[k] < done) done = back[k], state = checkpoints[done % places];
        for (; done < valid[k]; ++done) {
            checkpoints[done % places] = state;
            if (arrival[done] <= until) filter.step(state, rows[done], rows.fate(done));
        }
        if (k == n) break;
        const Time time = times[turn[k]];
        filter.estimate(state, Arrived{rows, arrival, until}, done, count, time, time, outputs, n, turn[k]);
    }
}

}  // namespace pumafuse
