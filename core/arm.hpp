// The arm of an axis: gain, plant, the fastest speed of its drive, play, sag.
//
// The drive is asked for the speed s that takes back its gap v - x within the plant's lag L (tau, or 2 zeta/omega), and
// gives V at most:
//     first order   x' = s,     second order   x" = 2 sigma (s - x'),     s = clip((v - x) / L, -V, V)
// Below V that is the linear plant, and |x'| never exceeds V. The tool is within half the play of the drive, which
// pushes it: y <- clip(y, x - h, x + h).
//
// Between events v = u + e exp(-b t), and x has a closed form while the gap is on one side of L V (`moved`). The path is
// cut where it crosses to the other side, and where the drive turns, since the tool stays there. s is continuous, so a
// cut that comes dt too late changes x by dt^2 alone, and not at all how x changes with parameters.
#pragma once
#include <limits>
#include <numbers>

#include "plant.hpp"

namespace pumafuse {

// Where a drive is, and where it is to go: u + e.
template <class Real>
struct Drive {
    double u = 0.0;             // the command in force [m]
    Real error = 0.0;           // the gain error e now [m]
    Real x = 0.0, rate = 0.0;   // m, m/s; the rate of a plant of first order is not kept: it is 0

    Real gap() const { return u + error - x; }
};

template <class Real>
Real clip(const Real& a, const Real& low, const Real& high) {
    return value_of(a) < value_of(low) ? low : value_of(a) > value_of(high) ? high : a;
}

inline bool changes(double first, double last) { return (first > 0.0) != (last > 0.0); }  // the sign

// Just behind the only instant in (0, end) at which f changes its sign (Illinois; Dowell & Jarratt, BIT 11, 1971).
// Every fourth step halves the bracket, whatever f is.
double behind_change(auto f, double end, double last) {
    constexpr double WIDTH = 1e-7;  // of the interval: its square is what x can be wrong by, of what it moves
    const double width = WIDTH * end;
    double begin = 0.0, first = f(begin);
    for (int k = 1, before = 0; end - begin > 2.0 * width; ++k) {  // before: which end was last moved
        const double secant = end - last * (end - begin) / (last - first);
        const bool halve = k % 4 == 0 || last == first;  // both may be 0 where f has faded away
        const double t = halve ? 0.5 * (begin + end) : clip(secant, begin + width, end - width), now = f(t);
        const int moved = changes(now, last) ? -1 : 1;
        (moved < 0 ? begin : end) = t, (moved < 0 ? first : last) = now;
        if (moved == std::exchange(before, moved)) (moved < 0 ? last : first) *= 0.5;
    }
    return end;
}

template <class Real>
struct Arm {
    Plant<Real> plant;
    Real slope, intercept;  // s/m, 1
    double period;          // s
    Real max_speed;         // V [m/s]; 0: there is none
    Real half_play;         // h [m]
    Real sag_offset, sag_slope, sag_knee, sag_slope_beyond, sag_knee_below, sag_slope_below;  // m, 1, m, 1, m, 1
    bool linear, sags;

    explicit Arm(const Axis<Real>& axis)
        : plant(axis), slope(axis.slope), intercept(axis.intercept), period(value_of(axis.period)),
          max_speed(axis.max_speed), half_play(0.5 * axis.play), sag_offset(axis.sag_offset),
          sag_slope(axis.sag_slope), sag_knee(axis.sag_knee), sag_slope_beyond(axis.sag_slope_beyond),
          sag_knee_below(axis.sag_knee_below), sag_slope_below(axis.sag_slope_below) {
        linear = value_of(max_speed) == 0.0 && value_of(half_play) == 0.0;
        sags = value_of(sag_offset) != 0.0 || value_of(sag_slope) != 0.0 || value_of(sag_slope_beyond) != 0.0 ||
               value_of(sag_slope_below) != 0.0;
        const Real lag = plant.order == 1 ? axis.time_constant : 2.0 * axis.damping / axis.natural_frequency;
        per_lag = 1.0 / lag;
        farthest = value_of(max_speed) > 0.0 ? value_of(lag * max_speed) : std::numeric_limits<double>::infinity();
        fast = value_of(plant.order == 1 ? plant.rate : plant.omega);
        const double turning = square(value_of(plant.omega)) - square(value_of(plant.sigma));
        half_swing = turning > 0.0 ? 3.0 / std::sqrt(turning) : std::numeric_limits<double>::infinity();  // 3 < pi
        const bool may_turn = plant.order == 2 || value_of(plant.decay) > 0.0;  // between two commands
        cut_by_play = may_turn && value_of(half_play) > 0.0, cut_by_limit = may_turn && value_of(max_speed) > 0.0;
        drawn = value_of(plant.drawn());
        overshoot = turning > 0.0 ? 1.0 / std::tanh(0.5 * std::numbers::pi * value_of(plant.sigma) / std::sqrt(turning))
                                  : 1.0;
    }

    Real gain_error(double step) const { return (slope * (std::fabs(step) / period) + intercept - 1.0) * step; }

    // How fast the drive goes; one of second order that is asked for a speed follows.
    Real speed(const Drive<Real>& d) const { return plant.order == 1 ? asked(d, side(d)) : d.rate; }

    // How far the tool hangs at a position p [m] as logged, and how that changes with p.
    Real sag(const Real& p) const {
        const Real at = sag_offset + sag_slope * p;
        if (value_of(p) > value_of(sag_knee)) return at + (sag_slope_beyond - sag_slope) * (p - sag_knee);
        return value_of(p) < value_of(sag_knee_below) ? at + (sag_slope_below - sag_slope) * (p - sag_knee_below) : at;
    }
    Real sag_rate(const Real& p) const {
        if (value_of(p) > value_of(sag_knee)) return sag_slope_beyond;
        return value_of(p) < value_of(sag_knee_below) ? sag_slope_below : sag_slope;
    }

    // The drive over dt, and what is left of the tool's slack (tool less drive) behind it.
    void move(Drive<Real>& d, Real& slack, const Real& dt) const {
        if (linear) return free(d, plant.over(dt), dt);
        const Drive<Real> before = d;
        const int side = this->side(d);
        if (side != 0) at_limit(d, side, dt);
        else free(d, plant.over(dt), dt);
        const auto turning = [&] {
            if (value_of(plant.decay) == 0.0) return changes(value_of(before.rate), value_of(d.rate));
            const Motion m = motion(before, side), n = motion(d, side);
            const auto slope_then = [&] { return later_slope(side, m, d, plant.over(dt)); };
            return (cut_by_play && turns(m, m.rate, n.rate, slope_then)) ||
                   (cut_by_limit && turns(m, m.closing, n.closing, slope_then));
        };
        if ((side == 0 && value_of(dt) > half_swing) || this->side(d) != side ||
            ((cut_by_play || cut_by_limit) && turning()))
            d = before, in_pieces(d, slack, dt);
        else slack = pushed(slack, before, d);
    }

  private:
    static constexpr double STILL = 1e-12;      // m; what moves by less is at rest: a thousandth of PF_FINEST
    static constexpr int MOST_PIECES = 10'000;  // of a path: an axis that swings on and on between two events

    Real per_lag;       // 1/L [1/s]
    double farthest;    // L V [m]: a gap that asks for more than the limit is larger
    double fast;        // 1/tau or omega [1/s]
    bool cut_by_play, cut_by_limit;  // where the drive turns, or its gap no longer closes
    double drawn;       // c: times an input that decays it follows; 0: not for ever, its decay is close to a pole
    double overshoot;   // times an input it goes at most: the integral of |g| omega^2
    double half_swing;  // s; within it a free plant turns once at most, and a drive at its limit whenever

    // 1 or -1 where the drive is asked for more than V, that way; else 0.
    int side(const Drive<Real>& d) const {
        const double gap = value_of(d.gap());
        return gap > farthest ? 1 : gap < -farthest ? -1 : 0;
    }

    // s.
    Real asked(const Drive<Real>& d, int side) const {
        if (side != 0) return double(side) * max_speed;
        return plant.order == 1 ? plant.rate * d.gap() : per_lag * d.gap();
    }

    // Whether the drive goes on without its limit, and neither turns against its tool nor leaves it: no cut is needed.
    //
    // It swings about u + c e, which an input that decays draws it along. The energy of that only falls, which bounds how
    // large a gap and how far from its tool it gets. Where the decay is close to a pole there is no such path: then the
    // gain error adds what it can at most.
    bool undisturbed(const Drive<Real>& d, const Real& slack) const {
        const double e = value_of(d.error), along = drawn * e, forced = drawn == 0.0 ? overshoot * std::fabs(e) : 0.0;
        const double x = value_of(d.x) - d.u, rate = value_of(d.rate) + value_of(plant.decay) * along;
        const double swing = std::hypot(x - along, plant.order == 1 ? 0.0 : rate / fast) + forced;
        const double gap = swing + std::fabs(e - along), tool = x + value_of(slack);
        if (gap < STILL) return true;
        // Where it has just turned it swings up to the tool, but for rounding.
        const double apart = value_of(half_play) + STILL - std::max(std::fabs(tool), std::fabs(tool - along));
        return gap <= farthest && (!cut_by_play || swing < STILL || swing <= apart);
    }

    // x <- u + Phi (x - u) + Gamma_e e
    void free(Drive<Real>& d, const Transition<Real>& f, const Real& dt) const {
        const Decay<Real> e = plant.decaying(f, dt);
        const Real gap = d.x - d.u, before = d.rate;
        d.x = d.u + (f.f11 * gap + f.f12 * before) + e.position * d.error;
        d.rate = f.f21 * gap + f.f22 * before + e.rate * d.error, d.error = d.error * e.left;
    }

    // x <- x + V dt, and of second order what it misses of V fades.
    void at_limit(Drive<Real>& d, int side, const Real& dt) const {
        using std::exp, std::expm1;
        const Real fastest = double(side) * max_speed;
        d.x = d.x + fastest * dt;
        if (value_of(plant.decay) > 0.0) d.error = d.error * exp(-plant.decay * dt);
        if (plant.order == 1) return;
        const Real gained = expm1(-2.0 * plant.sigma * dt) * (d.rate - fastest);
        d.x = d.x - gained / (2.0 * plant.sigma), d.rate = d.rate + gained;
    }

    Real pushed(const Real& slack, const Drive<Real>& before, const Drive<Real>& after) const {
        return clip<Real>(slack + (before.x - after.x), -half_play, half_play);
    }

    // How fast the drive goes and the gap closes. With a factor of exp(bt) both have the slope x" + b x', which is free
    // of the gain error and moves as the free plant does: it changes its sign once at most within half a swing, and on
    // either side of that each of the two does (Rolle).
    struct Motion { double rate, closing, slope; };

    Motion motion(const Drive<Real>& d, int side) const {
        const double s = value_of(asked(d, side)), rate = plant.order == 1 ? s : value_of(d.rate);
        const double decay = value_of(plant.decay), closing = decay * value_of(d.error) + rate;
        if (plant.order == 2) return {rate, closing, 2.0 * value_of(plant.sigma) * (s - rate) + decay * rate};
        return {rate, closing, decay * rate - (side == 0 ? fast * closing : 0.0)};
    }

    // The slope `then`, by the transition f to there; by the gain error it would be rounding, once it is small.
    double later_slope(int side, const Motion& m, const Drive<Real>& then, const Transition<Real>& f) const {
        if (side != 0) return motion(then, side).slope;
        if (plant.order == 1) return m.slope;  // of one sign
        const double decay = value_of(plant.decay), speeding = m.slope - decay * m.rate;
        const double change = (decay - 2.0 * value_of(plant.sigma)) * speeding - square(fast) * m.closing;
        return value_of(f.f11) * m.slope + value_of(f.f12) * change;
    }

    // Whether a rate changes its sign on the way, or may do so and back. `slope_then` says the slope at the end.
    static bool turns(const Motion& m, double first, double last, auto slope_then) {
        return changes(first, last) || (m.closing != m.rate && first * m.slope < 0.0 && last * slope_then() > 0.0);
    }

    // The path, cut where the drive turns, and where it meets or leaves its limit.
    void in_pieces(Drive<Real>& d, Real& slack, const Real& dt) const {
        Real left = dt;
        for (int pieces = 1; !is_zero(left); ++pieces) {
            const Drive<Real> before = d;
            left = left - piece(d, left, undisturbed(d, slack) || pieces == MOST_PIECES);
            slack = pushed(slack, before, d);
        }
    }

    // The drive over `left`, or up to the first cut. Returns how long that took.
    Real piece(Drive<Real>& d, const Real& left, bool whole) const {
        const int side = this->side(d);
        const auto moved = [&](const Real& t) {
            Drive<Real> then = d;
            if (value_of(t) == 0.0) return then;
            if (side != 0) at_limit(then, side, t);
            else free(then, plant.computed(t), t);
            return then;
        };
        Real taken = whole || side != 0 || value_of(left) <= half_swing ? left : Real(half_swing);
        Drive<Real> then = moved(taken);
        if (whole) {
            d = then;
            return taken;
        }
        const auto up_to_change_of = [&](auto f, double last) {
            if (!changes(f(0.0), last)) return;
            taken = behind_change(f, value_of(taken), last);
            then = moved(taken);
        };
        const auto up_to_turn = [&](double Motion::*of) {
            const Motion m = motion(d, side);
            const auto rate = [&](double t) { return motion(moved(t), side).*of; };
            const auto slope_at = [&](double t) { return later_slope(side, m, moved(t), plant.computed(t)); };
            const double last = motion(then, side).*of, end = value_of(taken);
            if (!changes(m.*of, last) && turns(m, m.*of, last, [&] { return slope_at(end); }))
                up_to_change_of(slope_at, slope_at(end));
            up_to_change_of(rate, motion(then, side).*of);
        };
        if (cut_by_play) up_to_turn(&Motion::rate);
        if (cut_by_limit) up_to_turn(&Motion::closing);
        if (value_of(max_speed) > 0.0) {
            const auto beyond = [&](const Drive<Real>& at) {
                const double gap = value_of(at.gap());
                return (side == 0 ? std::fabs(gap) : side * gap) - farthest;
            };
            up_to_change_of([&](double t) { return beyond(moved(t)); }, beyond(then));
        }
        d = then;
        return taken;
    }
};

}  // namespace pumafuse
