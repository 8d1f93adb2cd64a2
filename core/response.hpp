// The response r: what the commands do to an axis. Known, without noise. Another plant is another response.
#pragma once
#include "plant.hpp"

namespace pumafuse {

// Gain and plant of an axis. The gain error e is what K(speed) adds to each step; it decays with the recovery.
template <class Real>
struct Arm {
    Plant<Real> plant;
    Real slope, intercept;  // s/m, 1
    double period;          // s

    explicit Arm(const Axis<Real>& axis)
        : plant(axis), slope(axis.slope), intercept(axis.intercept), period(value_of(axis.period)) {}

    Real gain_error(double step) const { return (slope * (std::fabs(step) / period) + intercept - 1.0) * step; }
};

enum { LAG, GAIN, DOUBTS };  // what of a response may be doubted

template <class Of = double>
using ByDoubt = std::array<Of, DOUBTS>;  // how something changes with the lag [1/s] and with the gain, of 1

template <class Real>
struct Response {
    Instant<Real> time;
    double start = 0.0;          // u0 [m] as logged; all else is relative to it. NaN: not known
    double u = 0.0, step = 0.0;  // the command in force and the step that it was [m]
    Real error = 0.0;            // the gain error e now [m]
    Real x = 0.0, rate = 0.0;    // m, m/s

    // x <- u + Phi (x - u) + Gamma_e e
    void predict(const Plant<Real>& plant, const Instant<Real>& to) {
        const Real dt = seconds(time, to);
        if (is_zero(dt)) return;
        const Transition<Real>& f = plant.over(dt);
        const Decay<Real> e = plant.decaying(f, dt);
        const Real gap = x - u, before = rate;
        x = u + (f.f11 * gap + f.f12 * before) + e.position * error;
        rate = f.f21 * gap + f.f22 * before + e.rate * error, error = error * e.left;
        time = to;
    }

    // From now on u is `command` [m] as logged. Returns the maneuver |u_n - 2 u_(n-1) + u_(n-2)| / T [m/s].
    double command(const Arm<Real>& arm, double command) {
        const double next = command - start, now = next - u, maneuver = std::fabs(now - step) / arm.period;
        error = error + arm.gain_error(now);
        u = next, step = now;
        return maneuver;
    }

    // Where it would be if nothing were held back: C (A x + B (u + e)) of a plant of first order.
    Real speed(const Arm<Real>& arm) const { return arm.plant.order == 1 ? arm.plant.rate * (u + error - x) : rate; }

    // How x changes with the lag, which sets it back, and with the gain, which it is proportional to.
    ByDoubt<> by_doubt(const Arm<Real>& arm) const { return {-value_of(speed(arm)), value_of(x)}; }
};

// Some more commands at their instants, ascending, and the positions at n instants, ascending too. Each follows from the
// last command alone, so that no bit of it depends on what else is asked for.
inline void follow(Response<double>& response, const Arm<double>& arm, Time delay, Time commands, const Time* given,
                   const double* command, Time n, const Time* time, double* position) {
    const auto to = [&](Response<double>& now, Time at) {
        if (now.time.ns == PF_ALWAYS) now.time.ns = at;
        now.predict(arm.plant, {at, 0.0});
    };
    for (Time k = 0, c = 0; k < n || c < commands;) {
        if (c < commands && (k == n || given[c] + delay <= time[k])) {
            to(response, given[c] + delay);
            response.command(arm, command[c++]);
        } else {
            Response<double> then = response;
            to(then, time[k]);
            position[k++] = then.x;
        }
    }
}

}  // namespace pumafuse
