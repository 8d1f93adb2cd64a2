// The arm of an axis: gain, plant, the fastest speed of its drive, play, sag.
//
// The drive is asked for the speed s that takes back its gap v - x within the plant's lag L (tau, or 2 zeta/omega), and
// gives V at most:
//     first order   x' = s,     second order   x" = 2 sigma (s - x'),     s = clip((v - x) / L, -V, V)
// Below V that is the linear plant, and |x'| never exceeds V. The tool is within half the play of the drive, which
// pushes it: y <- clip(y, x - h, x + h).
//
// Between events v = u + e exp(-b t), and x has a closed form while the gap is on one side of L V (`free`, `at_limit`).
// The path is cut where it crosses to the other side, and where the drive turns, since the tool stays there. s is
// continuous, so a cut that comes dt too late changes x by dt^2 alone, and not at all how x changes with parameters.
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

    // A copy takes number by number: one that takes two at once has to wait for what was just stored singly, which is a
    // third of a response's time.
    Drive() = default;
    Drive(double u, const Real& error, const Real& x, const Real& rate) : u(u), error(error), x(x), rate(rate) {}
    Drive(const Drive& d) : Drive(d.u, d.error, d.x, d.rate) {}
    Drive& operator=(const Drive& d) {
        u = d.u, error = d.error, x = d.x, rate = d.rate;
        return *this;
    }

    Real gap() const { return u + error - x; }
};

template <class Real>
Real clip(const Real& a, const Real& low, const Real& high) {
    return value_of(a) < value_of(low) ? low : value_of(a) > value_of(high) ? high : a;
}

inline bool changes(double first, double last) { return (first > 0.0) != (last > 0.0); }  // the sign

struct Course { double value, slope; };  // of something over time, and per s

// Where the cubic with these values and slopes at 0 and 1 is 0 between them. The values' signs differ.
inline double zero_of_cubic(const Course& first, const Course& last) {
    const double rise = last.value - first.value, third = first.slope + last.slope - 2.0 * rise;
    const double second = rise - first.slope - third;
    double low = 0.0, high = 1.0, x = -first.value / rise;
    for (int k = 0; k < 8; ++k) {  // Newton's method, which halves the bracket where it would leave it
        const double y = first.value + x * (first.slope + x * (second + x * third));
        (changes(y, last.value) ? low : high) = x;
        const double by = y / (first.slope + x * (2.0 * second + x * 3.0 * third)), next = x - by;
        x = next > low && next < high ? next : 0.5 * (low + high);
        if (std::fabs(by) < 1e-5) break;  // its square is what is left
    }
    return x;
}

// Just behind the only instant in (0, end) at which `course` changes its sign: there it is computed last. Between two
// instants it is close to a cubic; every fourth step halves the bracket, whatever it is.
double behind_change(double end, Course first, Course last, auto course) {
    constexpr double WIDTH = 1e-7;  // of the interval: its square is what x can be wrong by, of what it moves
    const double width = WIDTH * end;
    double begin = 0.0;
    for (int k = 1;; ++k) {
        const double span = end - begin;
        if (span <= 2.0 * width) return course(end), end;
        const Course from = {first.value, span * first.slope}, to = {last.value, span * last.slope};
        const double part = k % 4 == 0 ? 0.5 : zero_of_cubic(from, to);
        const double t = clip(begin + span * part + 0.5 * width, begin + width, end - width);
        const Course now = course(t);
        const bool behind = !changes(now.value, last.value);
        if (behind && std::fabs(now.value) <= width * std::fabs(now.slope)) return t;
        (behind ? end : begin) = t, (behind ? last : first) = now;
    }
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
        const bool decays = value_of(plant.decay) > 0.0, may_turn = plant.order == 2 || decays;  // between two commands
        may_return = plant.order == 2 && decays;
        cut_by_play = may_turn && value_of(half_play) > 0.0, cut_by_limit = may_turn && value_of(max_speed) > 0.0;
        drawn = value_of(plant.drawn());
        overshoot = turning > 0.0 ? 1.0 / std::tanh(0.5 * std::numbers::pi * value_of(plant.sigma) / std::sqrt(turning))
                                  : 1.0;
    }

    Real gain_error(double step) const { return (slope * (std::fabs(step) / period) + intercept - 1.0) * step; }

    // How fast the drive goes; one of second order that is asked for a speed follows.
    Real speed(const Drive<Real>& d) const { return plant.order == 1 ? asked_speed(d, side(d)) : d.rate; }

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
        if (linear) d = free(d, plant.over(dt), dt);
        else in_pieces(d, slack, dt);
    }
    // Over a dt that will not come again, as that of a measurement: to remember it takes longer than to compute it.
    void move_once(Drive<Real>& d, Real& slack, const Real& dt) const {
        if (linear) d = free(d, plant.compute(dt), dt);
        else in_pieces(d, slack, dt);
    }

  private:
    static constexpr double STILL = 1e-12;      // m; what moves by less is at rest: a thousandth of PF_FINEST
    static constexpr int MOST_PIECES = 10'000;  // of a path: an axis that swings on and on between two events

    Real per_lag;       // 1/L [1/s]
    double farthest;    // L V [m]: a gap that asks for more than the limit is larger
    double fast;        // 1/tau or omega [1/s]
    bool cut_by_play, cut_by_limit;  // where the drive turns, or its gap no longer closes
    bool may_return;                 // it may turn twice within half a swing
    double drawn;       // c: times an input that decays it follows; 0: not for ever, its decay is close to a pole
    double overshoot;   // times an input it goes at most: the integral of |g| omega^2
    double half_swing;  // s; within it a free plant turns once at most, and a drive at its limit whenever

    // 1 or -1 where the drive is asked for more than V, that way; else 0.
    int side(const Drive<Real>& d) const {
        const double gap = value_of(d.gap());
        return gap > farthest ? 1 : gap < -farthest ? -1 : 0;
    }

    // s.
    Real asked_speed(const Drive<Real>& d, int side) const {
        if (side != 0) return double(side) * max_speed;
        return plant.order == 1 ? plant.rate * d.gap() : per_lag * d.gap();
    }

    // Whether the drive goes on without its limit, and neither turns against its tool nor leaves it: no cut is needed.
    //
    // It swings about u + c e, which an input that decays draws it along. The energy of that only falls, which bounds
    // how large a gap and how far from its tool it gets. Where the decay is close to a pole there is no such path: then
    // the gain error adds what it can at most.
    bool is_undisturbed(const Drive<Real>& d, const Real& slack) const {
        const double e = value_of(d.error), along = drawn * e, forced = drawn == 0.0 ? overshoot * std::fabs(e) : 0.0;
        const double x = value_of(d.x) - d.u, rate = value_of(d.rate) + value_of(plant.decay) * along;
        const double swing = std::sqrt(square(x - along) + (plant.order == 1 ? 0.0 : square(rate / fast))) + forced;
        const double gap = swing + std::fabs(e - along), tool = x + value_of(slack);
        if (gap < STILL) return true;
        // Where it has just turned it swings up to the tool, but for rounding.
        const double apart = value_of(half_play) + STILL - std::max(std::fabs(tool), std::fabs(tool - along));
        return gap <= farthest && (!cut_by_play || swing < STILL || swing <= apart);
    }

    // x <- u + Phi (x - u) + Gamma_e e
    Drive<Real> free(const Drive<Real>& d, const Transition<Real>& f, const Real& dt) const {
        const Decay<Real> e = plant.decaying(f, dt);
        const Real gap = d.x - d.u;
        return {d.u, d.error * e.left, d.u + (f.f11 * gap + f.f12 * d.rate) + e.position * d.error,
                f.f21 * gap + f.f22 * d.rate + e.rate * d.error};
    }

    // x <- x + V dt, and of second order what it misses of V fades.
    Drive<Real> at_limit(const Drive<Real>& d, int side, const Real& dt) const {
        using std::exp;
        const Real fastest = double(side) * max_speed, x = d.x + fastest * dt;
        const Real error = value_of(plant.decay) > 0.0 ? d.error * exp(-plant.decay * dt) : d.error;
        if (plant.order == 1) return {d.u, error, x, 0.0};
        const Real gained = (exp(-2.0 * plant.sigma * dt) - 1.0) * (d.rate - fastest);
        return {d.u, error, x - gained / (2.0 * plant.sigma), d.rate + gained};
    }

    Real push(const Real& slack, const Drive<Real>& before, const Drive<Real>& after) const {
        return clip<Real>(slack + (before.x - after.x), -half_play, half_play);
    }

    // How fast the drive goes and the gap closes. With a factor of exp(bt) both have the slope x" + b x', which is free
    // of the gain error and moves, with its own rate, as the free plant does: it changes its sign once at most within
    // half a swing, and on either side of that each of the two does (Rolle).
    struct Motion { double rate, closing, slope, slope_rate; };

    [[gnu::always_inline]] Motion motion(const Drive<Real>& d, int side) const {
        const double s = value_of(asked_speed(d, side)), rate = plant.order == 1 ? s : value_of(d.rate);
        const double decay = value_of(plant.decay), closing = decay * value_of(d.error) + rate;
        if (plant.order == 1) return {rate, closing, decay * rate - (side == 0 ? fast * closing : 0.0), 0.0};
        const double sigma = value_of(plant.sigma), speeding = 2.0 * sigma * (s - rate);
        const double restoring = side == 0 ? square(fast) * closing : 0.0;
        return {rate, closing, speeding + decay * rate, (decay - 2.0 * sigma) * speeding - restoring};
    }

    // That of a drive that sets out, to go dt: a moment later, where it is at rest, so that its rates have signs.
    Motion at_first(const Drive<Real>& d, int side, double dt) const {
        Motion m = motion(d, side);
        for (double Motion::*of : {&Motion::rate, &Motion::closing})
            if (m.*of == 0.0) m.*of = 1e-9 * dt * m.slope;
        return m;
    }

    // That of `then`, dt behind `m` by the transition f of the free plant. By the gap, as at first, it would be
    // rounding once little is left of it; so is what f leaves of a plant of first order, in the end.
    Motion later(const Motion& m, const Drive<Real>& then, const Transition<Real>& f, double dt) const {
        const double slope = value_of(f.f11) * m.slope + value_of(f.f12) * m.slope_rate;
        const double decay = value_of(plant.decay), e = value_of(then.error);
        double rate = value_of(then.rate);
        if (plant.order == 1 && value_of(f.f11) > 1e-6 && std::fabs(decay - fast) > 1e-6 * fast)
            rate = (slope + fast * decay * e) / (decay - fast);
        else if (plant.order == 1)
            rate = m.rate * std::exp(-decay * dt) + m.slope * divided_difference(fast, decay, dt);
        return {rate, decay * e + rate, slope, value_of(f.f21) * m.slope + value_of(f.f22) * m.slope_rate};
    }

    // A rate of the motion over time.
    Course course(const Motion& m, double Motion::*of) const {
        return {m.*of, m.slope - value_of(plant.decay) * m.*of};
    }

    // Whether the drive may have to be cut where one of the two changes its sign, as far as both ends tell at a glance:
    // it need not where both keep it by more than rounding, and do not turn to it and back.
    bool may_turn(const Drive<Real>& d, const Drive<Real>& then, int side) const {
        if (!(cut_by_play || cut_by_limit)) return false;
        const double still = STILL * fast;
        const auto keeps = [&](double first, double last) {
            return first > 0.0 ? first > still && last > still : first < -still && last < -still;
        };
        if (value_of(plant.decay) == 0.0) return !keeps(value_of(d.rate), value_of(then.rate));
        const Motion m = motion(d, side), n = motion(then, side);
        const auto stays = [&](double first, double last) {
            const double away = last > 0.0 ? n.slope : -n.slope;
            return keeps(first, last) && !(may_return && m.slope * first < 0.0 && away > -still * fast);
        };
        return (cut_by_play && !stays(m.rate, n.rate)) || (cut_by_limit && !stays(m.closing, n.closing));
    }

    // Whether one of the two changes its sign on the way, or may do so and back.
    bool turns(const Motion& m, const Motion& n, double Motion::*of) const {
        return changes(m.*of, n.*of) || (may_return && m.*of * m.slope < 0.0 && n.*of * n.slope > 0.0);
    }

    // Whether the drive has to be cut where it turns against its tool, or where its gap turns near the limit: a gap
    // that turns once, and slows down from the start, gets no farther than at the speed that it has.
    bool play_cuts(const Motion& m, const Motion& n) const { return cut_by_play && turns(m, n, &Motion::rate); }
    bool limit_cuts(const Drive<Real>& d, const Motion& m, const Motion& n, double dt) const {
        if (!cut_by_limit || !turns(m, n, &Motion::closing)) return false;
        const double apart = std::fabs(std::fabs(value_of(d.gap())) - farthest);
        return !changes(m.closing, n.closing) || m.closing * m.slope > 0.0 || std::fabs(m.closing) * dt > apart;
    }

    // The path, cut where the drive turns, and where it meets or leaves its limit.
    void in_pieces(Drive<Real>& d, Real& slack, const Real& dt) const {
        Real left = dt;
        for (int pieces = 1; !is_zero(left); ++pieces) {
            const int side = this->side(d);
            const bool may_cut = pieces < MOST_PIECES;
            const bool swings = side == 0 && value_of(left) > half_swing && may_cut && !is_undisturbed(d, slack);
            Real taken = swings ? Real(half_swing) : left;
            Drive<Real> then = side != 0 ? at_limit(d, side, taken) : free(d, plant.over(taken), taken);
            if ((this->side(then) != side || may_turn(d, then, side)) && may_cut)
                std::tie(then, taken) = cut(d, then, slack, side, taken);
            slack = push(slack, d, then), d = then, left = left - taken;
        }
    }

    // The path up to its first cut on the way to `then`, or to that; and how long it takes. Not a part of the loop,
    // which is small and seldom comes here.
    [[gnu::noinline]] std::tuple<Drive<Real>, Real> cut(Drive<Real> d, Drive<Real> then, Real slack, int side,
                                                        Real taken) const {
        if (is_undisturbed(d, slack)) return {then, taken};
        const Motion m = at_first(d, side, value_of(taken));
        Motion n = side == 0 ? later(m, then, plant.over(taken), value_of(taken)) : motion(then, side);
        const auto move_to = [&](const Real& t) {
            taken = t;
            if (side == 0) {
                const Transition<Real> f = plant.compute(t);
                then = free(d, f, t), n = later(m, then, f, value_of(t));
            } else then = at_limit(d, side, t), n = motion(then, side);
        };
        const auto up_to_change = [&](const Course& first, auto course) {
            const Course last = course();
            if (changes(first.value, last.value))
                behind_change(value_of(taken), first, last, [&](double t) { return move_to(t), course(); });
        };
        const auto up_to_turn = [&](double Motion::*of) {
            if (!changes(m.*of, n.*of)) {
                const auto uncut = std::tuple(then, n, taken);
                up_to_change({m.slope, m.slope_rate}, [&] { return Course{n.slope, n.slope_rate}; });
                if (!changes(m.*of, n.*of)) return std::tie(then, n, taken) = uncut, void();
            }
            up_to_change(course(m, of), [&] { return course(n, of); });
        };
        if (play_cuts(m, n)) up_to_turn(&Motion::rate);
        if (limit_cuts(d, m, n, value_of(taken))) up_to_turn(&Motion::closing);
        if (value_of(max_speed) > 0.0) {
            const auto beyond = [&](const Drive<Real>& at, const Motion& now) -> Course {
                const double gap = value_of(at.gap()), sign = side != 0 ? side : gap < 0.0 ? -1.0 : 1.0;
                return {sign * gap - farthest, -sign * now.closing};
            };
            up_to_change(beyond(d, m), [&] { return beyond(then, n); });
        }
        return {then, taken};
    }
};

}  // namespace pumafuse
