// Plants of first and second order, and the smooth disturbance, over any interval t: exact, in closed form.
//
// The response g of the free plant (g" = -2 sigma g' - omega^2 g, g(0) = 0, g'(0) = 1) gives
//     Phi = [ g' + 2 sigma g, g; -omega^2 g, g' ],
//     Q11 = omega^4 ∫ g^2,  Q12 = ½ omega^4 g^2,  Q22 = omega^2 Q11 + 2 sigma Q12 + omega^4 g g'
// for unit noise on the input. While the fastest pole turns by less than half a radian, g and ∫ g^2 come from their
// Taylor series: closed forms would lose all digits of Q11 ~ t^3. Beyond, from exponentials, in the form that does not
// cancel.
#pragma once
#include <algorithm>
#include <utility>

#include "model.hpp"

namespace pumafuse {

template <class Real>
struct Transition { Real f11, f12, f21, f22, q11, q12, q22; };  // Phi and Q

template <class Real>
struct Decay { Real position, rate, left; };  // what an input makes that decays from 1 m, and what is left of it

inline constexpr double SERIES = 1.0;  // |s| up to which even functions of sqrt(s) are summed
inline constexpr int EVEN_TERMS = 10;
inline constexpr auto FACTORIAL = [] {
    std::array<double, 2 * EVEN_TERMS + 2> inverse{1.0};
    for (int k = 1; k < 2 * EVEN_TERMS + 2; ++k) inverse[k] = inverse[k - 1] / k;
    return inverse;
}();

// cosh(sqrt(s)) and sinh(sqrt(s)) / sqrt(s) of a small s of either sign: smooth where poles meet.
template <class Real>
std::array<Real, 2> even(Real s) {
    Real cosh = 0.0, sinhc = 0.0;
    for (int k = EVEN_TERMS; k >= 0; --k) cosh = cosh * s + FACTORIAL[2 * k], sinhc = sinhc * s + FACTORIAL[2 * k + 1];
    return {cosh, sinhc};
}

// ∫ exp(-a s) exp(-b (t - s)) ds = (exp(-b t) - exp(-a t)) / (a - b), in the form that does not cancel.
template <class Real>
Real divided_difference(Real a, Real b, Real t) {
    using std::exp;
    const Real s = square(0.5 * (a - b) * t);
    if (value_of(s) < SERIES) return exp(-0.5 * (a + b) * t) * t * even(s)[1];
    return (exp(-b * t) - exp(-a * t)) / (a - b);
}

template <class Real>
class Plant {
  public:
    int order = 1;
    Real rate = 0.0;                // 1/tau of a plant of first order
    Real omega = 0.0, sigma = 0.0;  // of second order; sigma = zeta omega

    Plant() = default;

    explicit Plant(const Axis<Real>& axis) : order(value_of(axis.time_constant) > 0.0 ? 1 : 2) {
        if (order == 1) {
            rate = 1.0 / axis.time_constant;
            return;
        }
        omega = axis.natural_frequency, sigma = axis.damping * omega;
        apart = (axis.damping - 1.0) * (axis.damping + 1.0) * omega * omega;
        fastest = value_of(apart) > 0.0 ? value_of(sigma) + std::sqrt(value_of(apart)) : value_of(omega);
        const Real s = sigma / fastest, w = square(omega / fastest);  // in the time u, where no coefficient overflows
        std::array<Real, TERMS + 2> g{};
        std::array<Real, TERMS + 3> y{};  // g^2: y''' = -6 sigma y'' - (8 sigma^2 + 4 omega^2) y' - 8 sigma omega^2 y
        g[1] = y[2] = 1.0;
        for (int k = 0; k < TERMS; ++k) {
            const double a = k + 1, b = k + 2, c = k + 3;
            g[k + 2] = -(2.0 * s * a * g[k + 1] + w * g[k]) / (a * b);
            y[k + 3] = -(6.0 * s * (a * b) * y[k + 2] + (8.0 * s * s + 4.0 * w) * a * y[k + 1] + 8.0 * s * w * y[k]) /
                       (a * b * c);
        }
        for (int k = 0; k < TERMS; ++k) series[k] = {g[k + 1], g[k + 1] * double(k + 1), y[k + 2] / double(k + 3)};
    }

    // A plant of first order has a rate, too, that is always 0: the algebra is the same for both orders.
    Transition<Real> over(Real t) const {
        using std::expm1;
        if (order == 1) {
            const Real lost = expm1(-rate * t);
            return {1.0 + lost, 0.0, 0.0, 0.0, -0.5 * rate * lost * (2.0 + lost), 0.0, 0.0};
        }
        const auto [g, g_rate, energy] = value_of(t) * fastest <= SHORT ? by_series(t) : by_exponentials(t);
        const Real w2 = omega * omega, h = w2 * g, q11 = w2 * w2 * energy, q12 = 0.5 * h * h;
        return {g_rate + 2.0 * sigma * g, g, -h, g_rate, q11, q12, w2 * q11 + 2.0 * sigma * q12 + h * w2 * g_rate};
    }

    // ∫ exp(A s) B exp(-decay (t - s)) ds: divided differences of exp at the plant's poles and at -decay [1/s].
    Decay<Real> decaying(const Transition<Real>& f, Real decay, Real t) const {
        using std::exp, std::fabs, std::sqrt;
        const Real left = exp(-decay * t);
        if (order == 1) {
            const bool close = fabs(value_of(rate - decay)) < CLOSE * value_of(rate + decay);
            return {rate * (close ? divided_difference(rate, decay, t) : (left - f.f11) / (rate - decay)), 0.0, left};
        }
        const Real w2 = omega * omega;
        const Real product = decay * decay - 2.0 * sigma * decay + w2;  // of the distances from the plant's poles
        const bool close = fabs(value_of(product)) < CLOSE * value_of(decay * decay + 2.0 * sigma * decay + w2);
        if (close && !(value_of(apart) > square(APART * value_of(sigma)) && value_of(t) * fastest > SHORT))
            return close_poles(decay, t, left);
        Real h = (left - f.f22 - (2.0 * sigma - decay) * f.f12) / product;
        if (close) {
            const Real fast = sigma + sqrt(apart), slow = w2 / fast;
            h = (divided_difference(slow, decay, t) - divided_difference(fast, decay, t)) / (fast - slow);
        }
        return {w2 * h, w2 * (f.f12 - decay * h), left};
    }

  private:
    using Free = std::array<Real, 3>;           // g, g', ∫ g^2
    static constexpr int TERMS = 16, FEW = 10;  // of each series: the next would be below 1e-16 of the sum
    static constexpr double TINY = 0.1;         // rad; up to which few terms are enough
    static constexpr double SHORT = 0.5;        // rad; fastest pole times interval up to which the series are used
    static constexpr double CLOSE = 0.05;       // of what it would be with the signs alike: below, sums cancel
    static constexpr double APART = 0.5;        // half the poles' distance over sigma, below which exponentials cancel

    Real apart = 0.0;                 // (zeta^2 - 1) omega^2: below 0 the poles are a pair
    double fastest = 0.0;             // rad/s
    std::array<Free, TERMS> series{};  // coefficients of g / u, g' and ∫ g^2 / u^3 in u = fastest t

    // Even and odd powers apart, so that sums wait for half as many others.
    Free by_series(Real t) const {
        const Real u = fastest * t, v = u * u;
        Free evens{}, odds{};
        for (int k = (value_of(u) <= TINY ? FEW : TERMS) - 2; k >= 0; k -= 2)
            for (int i = 0; i < 3; ++i)
                evens[i] = evens[i] * v + series[k][i], odds[i] = odds[i] * v + series[k + 1][i];
        const double r = fastest;
        const Real energy = (evens[2] + u * odds[2]) * u * v / (r * r * r);
        return {(evens[0] + u * odds[0]) * u / r, evens[1] + u * odds[1], energy};
    }

    Free by_exponentials(Real t) const {
        using std::cos, std::exp, std::expm1, std::fabs, std::sin, std::sqrt;
        const bool wide = fabs(value_of(apart)) > square(APART * value_of(sigma));
        const Real s = apart * t * t;
        if (!wide && fabs(value_of(s)) < SERIES) {
            const auto [cosh, sinhc] = even(s);
            const Real decay = exp(-sigma * t), g = decay * t * sinhc;
            return together(g, decay * cosh - sigma * g);
        }
        const Real beta = sqrt(value_of(apart) < 0.0 ? -apart : apart);
        if (value_of(apart) < 0.0) {
            const Real decay = exp(-sigma * t), sine = sin(beta * t), cosine = cos(beta * t), twice = decay * decay;
            const Real g = decay * sine / beta, g_rate = decay * cosine - sigma * g;
            if (!wide) return together(g, g_rate);
            const Real straight = -expm1(-2.0 * sigma * t) / (2.0 * sigma);
            const Real turning = (2.0 * sigma * (1.0 - twice * (cosine - sine) * (cosine + sine)) +
                                  4.0 * beta * twice * sine * cosine) / (4.0 * omega * omega);
            return {g, g_rate, (straight - turning) / (2.0 * beta * beta)};
        }
        const Real fast = sigma + beta, slow = omega * omega / fast, lasting = exp(-slow * t);
        if (!wide) {
            const Real gone = expm1(-2.0 * beta * t), g = -lasting * gone / (2.0 * beta);
            return together(g, 0.5 * lasting * (2.0 + gone) - sigma * g);
        }
        const Real brief = exp(-fast * t);
        return {(lasting - brief) / (2.0 * beta), (fast * brief - slow * lasting) / (2.0 * beta),
                (-expm1(-2.0 * slow * t) / (2.0 * slow) + expm1(-2.0 * sigma * t) / sigma -
                 expm1(-2.0 * fast * t) / (2.0 * fast)) / (4.0 * beta * beta)};
    }

    // With ∫ g^2 of poles that lie together, from the balance of energy:
    // 4 sigma ∫ g'^2 = 1 - g'^2 - omega^2 g^2 and omega^2 ∫ g^2 = ∫ g'^2 - sigma g^2 - g g'.
    Free together(Real g, Real g_rate) const {
        const Real w2 = omega * omega, moving = (1.0 - g_rate * g_rate - w2 * g * g) / (4.0 * sigma);
        return {g, g_rate, (moving - sigma * g * g - g * g_rate) / w2};
    }

    // Where divided differences cancel: series of a short interval, doubled.
    Decay<Real> close_poles(Real decay, Real t, Real left_then) const {
        using std::exp;
        const double most = std::max(fastest, value_of(decay)), turned = most * value_of(t);
        const int doublings = turned > SHORT ? int(std::ceil(std::log2(turned / SHORT))) : 0;
        const Real s = sigma / most, w = square(omega / most), b = decay / most;
        const Real u = most * t / std::ldexp(1.0, doublings);
        Real g_k = 0.0, g_next = 1.0, h_k = 0.0, power = 1.0, g = 0.0, g_rate = 0.0, h = 0.0;  // g_k, h_k: of u^k
        for (int k = 0; k < TERMS + 2; ++k) {
            g = g + g_k * power, h = h + h_k * power, g_rate = g_rate + double(k + 1) * g_next * power;
            h_k = (g_k - b * h_k) / double(k + 1);
            g_k = std::exchange(g_next, -(2.0 * s * double(k + 1) * g_next + w * g_k) / double((k + 1) * (k + 2)));
            power = power * u;
        }
        Real left = exp(-b * u);
        for (int k = 0; k < doublings; ++k) {
            h = (g_rate + 2.0 * s * g) * h + g * (g - b * h) + left * h, left = left * left;
            const Real doubled = (2.0 * g_rate + 2.0 * s * g) * g;
            g_rate = g_rate * g_rate - w * g * g, g = doubled;
        }
        const Real w2 = omega * omega, H = h / (most * most);
        return {w2 * H, w2 * (g / most - decay * H), left_then};
    }
};

// A disturbance of smoothness 3/2, covariance (1 + lambda |s|) exp(-lambda |s|) for a variance of 1: two states, d and
// its rate. With a = lambda t:
//     Phi = exp(-a) [ 1 + a, t; -lambda^2 t, 1 - a ],  Q = P - Phi P Phi^T,  P = diag(1, lambda^2)
// (Rasmussen & Williams, "Gaussian Processes for Machine Learning", 2006, eq. 4.17; Hartikainen & Särkkä, "Kalman
// filtering and smoothing solutions to temporal Gaussian process regression models", 2010.)
template <class Real>
Transition<Real> smooth_disturbance(Real lambda, Real t) {
    using std::exp;
    const Real a = lambda * t, y = 2.0 * a, left = exp(-a), both = exp(-y);
    Real rest = 1.0 - both * (1.0 + y + 0.5 * y * y);
    if (value_of(y) < 1.0) {  // that is lost for a small y: exp(y) - 1 - y - y^2 / 2 is summed
        Real term = y * y * y / 6.0;
        rest = term;
        for (int k = 4; k < 20; ++k) term = term * y / double(k), rest = rest + term;
        rest = rest * both;
    }
    return {left * (1.0 + a), left * t, -left * lambda * a, left * (1.0 - a),
            rest, 2.0 * lambda * a * a * both, lambda * lambda * (rest + 2.0 * y * both)};
}

}  // namespace pumafuse
