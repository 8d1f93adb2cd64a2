// Plants of first and second order over any interval t: exact, in closed form.
//
// The response g of the free plant (g" = -2 sigma g' - omega^2 g, g(0) = 0, g'(0) = 1) gives
//     Phi = [ g' + 2 sigma g, g; -omega^2 g, g' ],
//     Q11 = omega^4 ∫ g^2,  Q12 = ½ omega^4 g^2,  Q22 = omega^2 Q11 + 2 sigma Q12 + omega^4 g g'
// for unit noise on the input. While the fastest pole turns by less than half a radian, all of it comes from Taylor
// series: closed forms would lose all digits of Q11 ~ t^3. Beyond it comes from exponentials, or, where the poles lie
// so close together that these cancel, from a series over a part of the interval, doubled.
#pragma once
#include <algorithm>
#include <utility>

#include "model.hpp"

namespace pumafuse {

template <class Real>
struct Transition { Real f11{}, f12{}, f21{}, f22{}; };  // Phi

template <class Real>
struct Driven : Transition<Real> { Real q11{}, q12{}, q22{}; };  // and Q, of unit noise on the input

template <class Real>
struct Decay { Real position, rate, left; };  // what an input makes that decays from 1 m, and what is left of it

// ∫ exp(-a s) exp(-b (t - s)) ds = (exp(-b t) - exp(-a t)) / (a - b), also where a and b meet.
template <class Real>
Real divided_difference(Real a, Real b, Real t) {
    using std::exp, std::expm1;
    if (value_of(a) < value_of(b)) std::swap(a, b);
    const Real x = (a - b) * t;
    Real mean = 1.0;  // of exp(-s) for s from 0 to x
    if (value_of(x) > 1.0) mean = -expm1(-x) / x;
    else for (int k = 18; k > 1; --k) mean = 1.0 - x * mean / double(k);
    return exp(-b * t) * t * mean;
}

template <class Real>
class Plant {
  public:
    int order = 1;
    Real rate = 0.0;                // 1/tau of a plant of first order
    Real omega = 0.0, sigma = 0.0;  // of second order; sigma = zeta omega
    Real decay = 0.0;               // of the input [1/s]; 0: it stays

    Plant() = default;
    Plant(Real rate, Real decay) : rate(rate), decay(decay) {
        close = std::fabs(value_of(rate - decay)) < CLOSE * value_of(rate + decay);
        if (!close) share = rate / (rate - decay);
    }

    Plant(Real omega, Real zeta, Real decay) : order(2), omega(omega), sigma(zeta * omega), decay(decay) {
        apart = (zeta - 1.0) * (zeta + 1.0) * omega * omega;
        fastest = value_of(apart) > 0.0 ? value_of(sigma) + std::sqrt(value_of(apart)) : value_of(omega);
        far_apart = std::fabs(value_of(apart)) > square(APART * value_of(sigma));
        const Real product = decay * decay - 2.0 * sigma * decay + omega * omega;  // of the decay's distances from them
        close = std::fabs(value_of(product)) < CLOSE * value_of(decay * decay + 2.0 * sigma * decay + omega * omega);
        if (!close) share = 1.0 / product;
        s = sigma / fastest, w = square(omega / fastest), b = decay / fastest;
        std::array<Real, TERMS + 3> g{}, y{}, h{};  // y = g^2: y"' = -6 s y" - (8 s^2 + 4 w) y' - 8 s w y
        g[1] = y[2] = 1.0;
        for (int k = 0; k < TERMS; ++k) {
            const double p = k + 1, q = k + 2, r = k + 3;
            g[k + 2] = -(2.0 * s * p * g[k + 1] + w * g[k]) / (p * q);
            y[k + 3] = -(6.0 * s * (p * q) * y[k + 2] + (8.0 * s * s + 4.0 * w) * p * y[k + 1] + 8.0 * s * w * y[k]) /
                       (p * q * r);
            if (close) h[k + 2] = (g[k + 1] - b * h[k + 1]) / q;
            series[k] = {g[k + 1], g[k + 1] * p, h[k + 2], y[k + 2] / r};
        }
    }

    explicit Plant(const Axis<Real>& axis) {
        const Real decay = value_of(axis.recovery) > 0.0 ? 1.0 / axis.recovery : Real(0.0);
        if (value_of(axis.time_constant) > 0.0) *this = {1.0 / axis.time_constant, decay};
        else *this = {axis.natural_frequency, axis.damping, decay};
    }

    // A plant of first order has a rate, too, that is always 0: the algebra is the same for both orders. Some intervals
    // are remembered, as what comes regularly has few. The residual asks first: the response may share what it got.
    const Driven<Real>& driven_over(Real t) const { return look_up(driven, t); }
    const Transition<Real>& over(Real t) const {
        const auto& [last, transition] = driven[slot(t)];
        return is_zero(t - last) ? transition : look_up(undriven, t);
    }

    // Of an interval that will not come again.
    Transition<Real> compute(Real t) const {
        Transition<Real> f;
        compute(t, f);
        return f;
    }

    // Of an input that decays by `decay`; f is the plant's transition over t.
    Decay<Real> decaying(const Transition<Real>& f, Real t) const {
        using std::exp;
        if (value_of(decay) == 0.0) return {1.0 - f.f11, -f.f21, 1.0};
        const Real left = exp(-decay * t);
        if (order == 1) return {close ? rate * divided_difference(rate, decay, t) : share * (left - f.f11), 0.0, left};
        const Real h = close ? free<false>(t)[2] : share * (left - f.f22 - (2.0 * sigma - decay) * f.f12);
        return {omega * omega * h, omega * omega * (f.f12 - decay * h), left};
    }

    // c: what decays is followed to c times itself, once the plant's own motion has faded. 0 where it is close to a
    // pole.
    Real drawn() const { return close ? Real(0.0) : order == 1 ? share : omega * omega * share; }

  private:
    // g, g', h = ∫ g(s) exp(-decay (t - s)) ds and ∫ g^2; h only where the decay is close to a pole of the plant, and
    // the last only where it is asked for.
    using Free = std::array<Real, 4>;
    static constexpr int TERMS = 16, FEW = 10;  // of each series: the next would be below 1e-16 of the sum
    static constexpr double TINY = 0.1;         // rad; up to which few terms are enough
    static constexpr double SHORT = 0.5;        // rad; fastest pole times interval up to which the series are used
    static constexpr double CLOSE = 0.05;       // of what it would be with the signs alike: below, sums cancel
    static constexpr double APART = 0.5;        // half the poles' distance over sigma, below which exponentials cancel

    bool far_apart = false, close = false;
    Real apart = 0.0;                  // (zeta^2 - 1) omega^2: below 0 the poles are a pair
    Real share = 0.0;                  // what a decay that is not close to the poles has of their response
    double fastest = 0.0;              // rad/s
    Real s = 0.0, w = 0.0, b = 0.0;    // sigma, omega^2 and decay in the time u = fastest t
    std::array<Free, TERMS> series{};  // coefficients of g / u, g', h / u^2 and ∫ g^2 / u^3
    template <class Of>
    struct Remembered { Real interval = -1.0; Of transition{}; };
    template <class Of>
    using Some = std::array<Remembered<Of>, 8>;  // by a hash
    mutable Some<Transition<Real>> undriven{};
    mutable Some<Driven<Real>> driven{};

    static std::size_t slot(Real t) { return std::bit_cast<std::uint64_t>(value_of(t)) * 0x9E3779B97F4A7C15u >> 61; }

    template <class Of>
    const Of& look_up(Some<Of>& some, Real t) const {
        auto& [last, transition] = some[slot(t)];
        if (!is_zero(t - last)) last = t, compute(t, transition);  // in place: a copy would wait for it
        return transition;
    }

    template <class Of>
    void compute(Real t, Of& f) const {
        using std::expm1;
        constexpr bool NOISE = std::is_same_v<Of, Driven<Real>>;
        if (order == 1) {
            const Real lost = expm1(-rate * t);
            f.f11 = 1.0 + lost;
            if constexpr (NOISE) f.q11 = -0.5 * rate * lost * (2.0 + lost);
            return;
        }
        const auto [g, g_rate, h, energy] = free<NOISE>(t);
        const Real w2 = omega * omega, x = w2 * g;
        f.f11 = g_rate + 2.0 * sigma * g, f.f12 = g, f.f21 = -x, f.f22 = g_rate;
        if constexpr (NOISE) {
            f.q11 = w2 * w2 * energy, f.q12 = 0.5 * x * x;
            f.q22 = w2 * f.q11 + 2.0 * sigma * f.q12 + x * w2 * g_rate;
        }
    }

    template <bool ENERGY>
    Free free(Real t) const {
        return far_apart && fastest * value_of(t) > SHORT ? by_exponentials<ENERGY>(t) : by_doubling<ENERGY>(t);
    }

    template <bool ENERGY>
    Free by_doubling(Real t) const {
        using std::exp;
        constexpr int SUMS = ENERGY ? 4 : 3;
        int doublings = 0;
        if (const double u = fastest * value_of(t); u > SHORT) std::frexp(u / SHORT, &doublings);
        const Real u = fastest * t / std::ldexp(1.0, doublings), v = u * u;
        Free evens{}, odds{};  // apart, so that sums wait for half as many others
        for (int k = (value_of(u) <= TINY ? FEW : TERMS) - 2; k >= 0; k -= 2)
            for (int i = 0; i < SUMS; ++i)
                evens[i] = evens[i] * v + series[k][i], odds[i] = odds[i] * v + series[k + 1][i];
        Real g = (evens[0] + u * odds[0]) * u, g_rate = evens[1] + u * odds[1], h = (evens[2] + u * odds[2]) * v;
        Real energy = (evens[3] + u * odds[3]) * u * v;
        for (Real left = close ? exp(-b * u) : Real(0.0); doublings > 0; --doublings, left = left * left) {
            const Real f = g_rate + 2.0 * s * g, gg = g * g;  // Phi = [f, g; -w g, g']
            h = f * h + g * (g - b * h) + left * h;
            if constexpr (ENERGY)
                energy = energy + f * f * energy + f * g * gg + gg * (w * energy + s * gg + g * g_rate);
            g = (f + g_rate) * g, g_rate = g_rate * g_rate - w * gg;
        }
        return {g / fastest, g_rate, h / (fastest * fastest), energy / (fastest * fastest * fastest)};
    }

    template <bool ENERGY>
    Free by_exponentials(Real t) const {
        using std::cos, std::exp, std::expm1, std::sin, std::sqrt;
        Real h = 0.0, energy = 0.0;
        if (value_of(apart) < 0.0) {
            const Real beta = sqrt(-apart), lasting = exp(-sigma * t), sine = sin(beta * t), cosine = cos(beta * t);
            if constexpr (ENERGY) {
                const Real twice = lasting * lasting, straight = -expm1(-2.0 * sigma * t) / (2.0 * sigma);
                const Real turning = (2.0 * sigma * (1.0 - twice * (cosine - sine) * (cosine + sine)) +
                                      4.0 * beta * twice * sine * cosine) / (4.0 * omega * omega);
                energy = (straight - turning) / (2.0 * beta * beta);
            }
            const Real g = lasting * sine / beta;
            return {g, lasting * cosine - sigma * g, h, energy};
        }
        const Real beta = sqrt(apart), fast = sigma + beta, slow = omega * omega / fast;
        const Real brief = exp(-fast * t), lasting = exp(-slow * t);
        if constexpr (ENERGY)
            energy = (-expm1(-2.0 * slow * t) / (2.0 * slow) + expm1(-2.0 * sigma * t) / sigma -
                      expm1(-2.0 * fast * t) / (2.0 * fast)) / (4.0 * beta * beta);
        if (close) h = (divided_difference(slow, decay, t) - divided_difference(fast, decay, t)) / (2.0 * beta);
        return {(lasting - brief) / (2.0 * beta), (fast * brief - slow * lasting) / (2.0 * beta), h, energy};
    }
};

}  // namespace pumafuse
