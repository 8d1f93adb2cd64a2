// The response r: what the commands do to an axis. Known, without noise. Another arm is another response.
#pragma once
#include "arm.hpp"

namespace pumafuse {

enum { LAG, GAIN, DOUBTS };  // what of a response may be doubted

template <class Of = double>
using ByDoubt = std::array<Of, DOUBTS>;  // how something changes with the lag [1/s] and with the gain, of 1

template <class Real>
struct Response {
    Instant<Real> time;
    double start = 0.0;  // u0 [m] as logged; all else is relative to it. NaN: not known
    double step = 0.0;   // of the command in force [m]
    Drive<Real> drive;
    Real slack = 0.0;    // tool less drive [m], within half the play

    void predict(const Arm<Real>& arm, const Instant<Real>& to) {
        const Real dt = seconds(time, to);
        if (is_zero(dt)) return;
        arm.move(drive, slack, dt);
        time = to;
    }

    // From now on u is `command` [m] as logged; the gain error e is what K(speed) adds to the step, and decays with the
    // recovery. Returns the maneuver |u_n - 2 u_(n-1) + u_(n-2)| / T [m/s].
    double command(const Arm<Real>& arm, double command) {
        const double next = command - start, now = next - drive.u, maneuver = std::fabs(now - step) / arm.period;
        drive.error = drive.error + arm.gain_error(now);
        drive.u = next, step = now;
        return maneuver;
    }

    // r.
    Real position(const Arm<Real>& arm) const {
        const Real tool = drive.x + slack;
        return arm.sags ? tool + arm.sag(start + tool) : tool;
    }

    // r': within the play the tool rests. Of a plant of first order as if nothing held the input back.
    Real speed(const Arm<Real>& arm) const {
        const Real of_drive = arm.speed(drive);
        if (arm.linear && !arm.sags) return of_drive;
        const double pushed = value_of(of_drive) > 0.0 ? -value_of(slack) : value_of(slack);
        if (pushed < value_of(arm.half_play)) return 0.0;
        return arm.sags ? of_drive * (1.0 + arm.sag_rate(start + drive.x + slack)) : of_drive;
    }

    // How r changes with the lag, which sets it back, and with the gain, which it is proportional to.
    ByDoubt<> by_doubt(const Arm<Real>& arm) const { return {-value_of(speed(arm)), value_of(position(arm))}; }
};

// Some more commands at their instants, ascending, and the positions at n instants, ascending too. Each follows from
// the last command alone, so that no bit of it depends on what else is asked for.
inline void follow(Response<double>& response, const Arm<double>& arm, Time delay, Time commands, const Time* stamp,
                   const double* command, Time n, const Time* time, double* position) {
    const auto to = [&](Response<double>& now, Time at) {
        if (now.time.ns == PF_ALWAYS) now.time.ns = at;
        now.predict(arm, {at, 0.0});
    };
    for (Time k = 0, c = 0; k < n || c < commands;) {
        if (c < commands && (k == n || stamp[c] + delay <= time[k])) {
            to(response, stamp[c] + delay);
            response.command(arm, command[c++]);
        } else {
            Response<double> then = response;
            to(then, time[k]);
            position[k++] = then.position(arm);
        }
    }
}

}  // namespace pumafuse
