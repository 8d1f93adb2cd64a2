// The residual xi: what nobody commanded. Zero mean, linear, Gaussian: one Kalman filter.
//
// Its states, in this order: the plant's position and rate (0 for a plant of first order), driven by white noise on the
// input; the offset; the disturbance d and, where that is smooth, its rate; of each sensor that has them a bias that
// drifts and a constant one. The position is r + x[PLANT] + x[OFFSET] + x[DISTURBANCE].
#pragma once
#include <stdexcept>

#include "response.hpp"

namespace pumafuse {

enum { PLANT, RATE, OFFSET, DISTURBANCE };      // of x; where there is no disturbance, biases follow
enum class Smoothness { none, rough, smooth };  // no state, d alone, d and its rate

// What is known of the residual of one axis.
template <int N, class Real>
struct Noise {
    Real input_noise, drift, maneuver_noise, maneuver_drift, adaptation;  // as pf_axis has them
    bool maneuvers;  // whether commands change these
    bool adapts;     // whether innovations do
    bool doubted;    // whether lag or gain of the response are
    Smoothness smoothness = Smoothness::none;
    Plant<Real> disturbance;      // a smooth one is a plant with a double pole, driven by white noise
    Real density = 0.0;           // of that noise
    int size = DISTURBANCE;       // how many states there are
    Vector<N, Real> reverting{};  // how fast each reverts to 0 [1/s]; 0: it stays
    Vector<N, Real> variance{};   // of each at the start, and of what reverts for ever [m^2]
    Vector<N, Real> position{};   // h, which makes the position of the states

    Noise() = default;

    explicit Noise(const Axis<Real>& axis)
        : input_noise(axis.input_noise), drift(axis.drift), maneuver_noise(axis.maneuver_noise),
          maneuver_drift(axis.maneuver_drift), adaptation(axis.adaptation),
          maneuvers(value_of(maneuver_noise) != 0.0 || value_of(maneuver_drift) != 0.0),
          adapts(value_of(adaptation) != 0.0), doubted(value_of(axis.lag_sd) != 0.0 || value_of(axis.gain_sd) != 0.0) {
        variance[OFFSET] = square(axis.offset_sd), position[PLANT] = position[OFFSET] = 1.0;
        if (value_of(axis.disturbance_sd) == 0.0) return;
        smoothness = value_of(axis.smoothness) > 1.0 ? Smoothness::smooth : Smoothness::rough;
        const Real lambda = (smoothness == Smoothness::smooth ? std::sqrt(3.0) : 1.0) / axis.disturbance_time;
        position[add(lambda, square(axis.disturbance_sd))] = 1.0;
        if (smoothness == Smoothness::rough) return;
        add(lambda, square(lambda * axis.disturbance_sd));
        disturbance = {lambda, 1.0, 0.0}, density = 4.0 * square(axis.disturbance_sd) / lambda;
    }

    // The variance that a state reverts to: biases are the sensors', and do not change with an arm's unrest.
    Real variance_of(int i, const Real& scale) const {
        return i == DISTURBANCE && smoothness == Smoothness::rough ? scale * variance[i] : variance[i];
    }

    bool smooth() const { return DISTURBANCE + 1 < N && smoothness == Smoothness::smooth; }

    // Add a state; returns which.
    int add(Real rate, Real at_first) {
        if (size == N)
            throw std::length_error("an axis has more than 64 states: too many sensors have biases;"
                                    " set bias_sd and bias_drift_sd of some to 0 in fusion.toml");
        reverting[size] = rate, variance[size] = at_first;
        return size++;
    }

    // h (Phi - I): what the states make of a motion over dt [s].
    Vector<N, Real> motion(const Plant<Real>& plant, Real dt) const {
        using std::expm1;
        const Transition<Real>& f = plant.over(dt);
        Vector<N, Real> h{};
        h[PLANT] = f.f11 - 1.0, h[RATE] = f.f12;
        if (smoothness == Smoothness::rough) h[DISTURBANCE] = expm1(-reverting[DISTURBANCE] * dt);
        if (!smooth()) return h;
        const Transition<Real>& d = disturbance.over(dt);
        h[DISTURBANCE] = d.f11 - 1.0, h[DISTURBANCE + 1] = d.f12;
        return h;
    }
};

// M <- F M F^T where F moves the states i and i + 1.
template <int N, class Real>
void move_pair(Matrix<N, Real>& M, int i, Real f11, Real f12, Real f21, Real f22) {
    const int k = i + 1;
    const Real a = M[i][i], b = M[i][k], c = M[k][k], d = f11 * a + f12 * b, e = f11 * b + f12 * c;
    M[i][i] = d * f11 + e * f12;
    M[i][k] = M[k][i] = d * f21 + e * f22;
    M[k][k] = (f21 * a + f22 * b) * f21 + (f21 * b + f22 * c) * f22;
    for (int j = 0; j < N; ++j) {
        if (j == i || j == k) continue;
        const Real p = M[i][j], v = M[k][j];
        M[i][j] = M[j][i] = f11 * p + f12 * v;
        M[k][j] = M[j][k] = f21 * p + f22 * v;
    }
}

// M H^T and S = H M H^T + R. S cannot be known to be smaller than what rounding leaves of what it is made of.
template <int N, class Real>
struct Projection {
    Vector<N, Real> MH{};
    Real S = 0.0;

    Projection() = default;

    Projection(const Matrix<N, Real>& M, const Vector<N, Real>& H, Real R) : S(R) {
        constexpr double ROUNDING = 1e-15;
        Real diagonal = 0.0;
        for (int j = 0; j < N; ++j) {
            if (is_zero(H[j])) continue;
            for (int i = 0; i < N; ++i) MH[i] = MH[i] + M[j][i] * H[j];
        }
        for (int i = 0; i < N; ++i) diagonal = diagonal + H[i] * H[i] * M[i][i], S = S + H[i] * MH[i];
        if (value_of(S) < value_of(R)) S = R;
        if (value_of(S) < ROUNDING * value_of(diagonal)) S = ROUNDING * diagonal;
    }
};

// K = M H^T / S, and M <- (I - K H) M (I - K H)^T + K R K^T. Returns K.
//
// The smoother uses it for its dual, too. A state that H does not see and that shares nothing with the others changes
// no bit of theirs. A quotient is exactly 1 where a prior is all there is to S; a product with 1/S would leave a
// variance below 0.
template <int N, class Real>
Vector<N, Real> joseph(Matrix<N, Real>& M, const Vector<N, Real>& H, const Projection<N, Real>& projection, Real R) {
    Vector<N, Real> K, WH{};
    for (int i = 0; i < N; ++i) K[i] = projection.MH[i] / projection.S;
    for (int i = 0; i < N; ++i)  // W = (I - K H) M, and W H^T
        for (int j = 0; j < N; ++j) M[i][j] = M[i][j] - K[i] * projection.MH[j], WH[i] = WH[i] + M[i][j] * H[j];
    for (int i = 0; i < N; ++i)  // W - W H^T K^T + K R K^T; the last apart, or a wide prior would round it away
        for (int j = 0; j <= i; ++j) {
            const Real left = M[i][j] - WH[i] * K[j] + M[j][i] - WH[j] * K[i];
            M[i][j] = M[j][i] = 0.5 * left + K[i] * R * K[j];
        }
    for (int i = 0; i < N; ++i)  // rounding beside a prior 1e16 times as wide: known, as far as doubles go
        if (value_of(M[i][i]) < 0.0)
            for (int j = 0; j < N; ++j) M[i][j] = M[j][i] = 0.0;
    return K;
}

template <int N, class Real>
struct Residual {
    Instant<Real> time;  // of x and P
    Vector<N, Real> x{};
    Matrix<N, Real> P{};
    ByDoubt<Vector<N, double>> dx{};  // how x changes with lag and gain of the response, by way of measurements
    bool doubted = false;             // whether these are; a likelihood never asks
    Real q = 0.0, drift = 0.0;  // densities squared in force: input noise [m^2 s] and the offset's drift [m^2/s]
    Instant<Real> until;        // commands that change these have been taken into account until then:
    Driven<Real> since;         // Phi and Q of the plant from `time` on, Q with the noise that there was
    Real drifted = 0.0;         // what that has added to the offset's variance
    Real unrest = 0.0;          // logarithm of how many times as large its variances are as configured,
    Real scale = 1.0;           // and how many times: so until the next measurement

    Residual() = default;

    Residual(const Noise<N, Real>& noise, const Instant<Real>& origin) : time(origin), until(origin) {
        doubted = noise.doubted, set_noise(noise, 0.0);
        for (int i = 0; i < N; ++i) P[i][i] = noise.variance[i];
    }

    // x <- F x and P <- F P F^T + Q.
    void predict(const Plant<Real>& plant, const Noise<N, Real>& noise, const Instant<Real>& to) {
        using std::expm1;
        accumulate(plant, to);
        const Real dt = seconds(time, to);
        if (is_zero(dt)) return;
        if (plant.order == 1) fade(PLANT, since.f11);
        else move(PLANT, since);
        add(PLANT, since.q11, since.q12, since.q22);
        P[OFFSET][OFFSET] = P[OFFSET][OFFSET] + drifted, drifted = 0.0;
        int i = DISTURBANCE;
        if (noise.smooth()) {
            const Driven<Real>& d = noise.disturbance.driven_over(dt);
            const Real density = scale * noise.density;
            move(i, d), add(i, density * d.q11, density * d.q12, density * d.q22);
            i += 2;
        }
        for (; i < noise.size; ++i) {
            if (value_of(noise.reverting[i]) == 0.0) continue;
            const Real lost = expm1(-noise.reverting[i] * dt);
            fade(i, 1.0 + lost);
            P[i][i] = P[i][i] - noise.variance_of(i, scale) * lost * (2.0 + lost);
        }
        time = to;
    }

    // x <- x + K nu and P <- (I - K H) P (I - K H)^T + K R K^T, and dx <- dx + K d_nu. Returns K.
    Vector<N, Real> update(const Vector<N, Real>& H, const Projection<N, Real>& projection, Real nu,
                           const ByDoubt<>& d_nu, Real R) {
        Vector<N, Real> K;
        if constexpr (std::is_same_v<Real, double>) K = joseph<N, double>(P, H, projection, R);
        else K = joseph_tangent(P, H, projection, R);  // likelihood.hpp
        for (int i = 0; i < N; ++i) x[i] = x[i] + K[i] * nu;
        each_doubt([&](auto& column, int k) {
            for (int i = 0; i < N; ++i) column[i] += K[i] * d_nu[k];
        });
        return K;
    }

    Real mean(const Vector<N, Real>& h) const {  // h x
        Real sum = 0.0;
        for (int i = 0; i < N; ++i) sum = sum + h[i] * x[i];
        return sum;
    }

    Real variance(const Vector<N, Real>& h) const {  // h P h^T
        Real sum = 0.0;
        for (int i = 0; i < N; ++i)
            for (int j = 0; j < N; ++j) sum = sum + h[i] * P[i][j] * h[j];
        return value_of(sum) > 0.0 ? sum : Real(0.0);
    }

    // How far h x errs for each unit of a doubt: by what that changes of `scale` responses, less what x has followed.
    ByDoubt<> error_by_doubt(const ByDoubt<>& by_response, double scale, const Vector<N, Real>& h) const {
        ByDoubt<> error{};
        for (int k = 0; doubted && k < DOUBTS; ++k) {
            error[k] = scale * by_response[k];
            for (int i = 0; i < N; ++i) error[k] -= value_of(h[i]) * dx[k][i];
        }
        return error;
    }

    // Towards what a measurement says of the noise before it, by the score of its likelihood. (Creal, Koopman & Lucas,
    // "Generalized autoregressive score models with applications", J. Appl. Econometrics 28(5), 2013.)
    void learn(const Noise<N, Real>& noise, const Real& nu, const Real& S, const Real& R) {
        using std::exp;
        if (!noise.adapts) return;
        const Real score = (1.0 - R / S) * (square(nu) / S - 1.0);
        unrest = unrest + noise.adaptation * (value_of(score) < MOST ? score : Real(MOST));
        if (value_of(unrest) < 0.0) unrest = 0.0;
        scale = exp(unrest);
    }

    void set_noise(const Noise<N, Real>& noise, double maneuver) {
        q = square(noise.input_noise) + square(noise.maneuver_noise * maneuver);
        drift = square(noise.drift) + square(noise.maneuver_drift * maneuver);
    }

    // Phi_s <- Phi Phi_s and Q_s <- Phi Q_s Phi^T + q Q1. Commands change q, so that each ends an interval; x and P
    // wait for the next measurement, which saves half of the time of a likelihood.
    void accumulate(const Plant<Real>& plant, const Instant<Real>& to) {
        const Real dt = seconds(until, to);
        if (is_zero(dt)) return;
        const Driven<Real>& f = plant.driven_over(dt);
        const Real q = input();
        Driven<Real>& s = since;
        if (until.ns == time.ns && is_zero(until.shift - time.shift)) {  // the first: Phi_s is 1
            s = {f, q * f.q11, q * f.q12, q * f.q22};
        } else if (plant.order == 1) {
            s.f11 = f.f11 * s.f11, s.q11 = f.f11 * f.f11 * s.q11 + q * f.q11;
        } else {
            const Real a = f.f11 * s.q11 + f.f12 * s.q12, b = f.f11 * s.q12 + f.f12 * s.q22;
            const Real c = f.f21 * s.q11 + f.f22 * s.q12, d = f.f21 * s.q12 + f.f22 * s.q22;
            s.q11 = a * f.f11 + b * f.f12 + q * f.q11, s.q12 = a * f.f21 + b * f.f22 + q * f.q12;
            s.q22 = c * f.f21 + d * f.f22 + q * f.q22;
            const Real f11 = f.f11 * s.f11 + f.f12 * s.f21, f12 = f.f11 * s.f12 + f.f12 * s.f22;
            s.f21 = f.f21 * s.f11 + f.f22 * s.f21, s.f22 = f.f21 * s.f12 + f.f22 * s.f22;
            s.f11 = f11, s.f12 = f12;
        }
        drifted = drifted + drifting() * dt, until = to;
    }

    Real input() const { return scale * q; }         // densities squared as they are now
    Real drifting() const { return scale * drift; }

  private:
    static constexpr double MOST = 10.0;  // of a score: an outlier that passed the gate is no unrest

    void each_doubt(auto work) {
        if constexpr (std::is_same_v<Real, double>)
            for (int k = 0; doubted && k < DOUBTS; ++k) work(dx[k], k);
    }

    void fade(int i, Real left) {
        x[i] = x[i] * left;
        each_doubt([&](auto& column, int) { column[i] *= left; });
        for (int j = 0; j < N; ++j) P[i][j] = P[i][j] * left, P[j][i] = P[j][i] * left;
    }

    void move(int i, const Transition<Real>& f) {
        move(x, i, f);
        each_doubt([&](auto& column, int) { move(column, i, f); });
        move_pair<N, Real>(P, i, f.f11, f.f12, f.f21, f.f22);
    }

    static void move(Vector<N, Real>& x, int i, const Transition<Real>& f) {
        const Real a = x[i], b = x[i + 1];
        x[i] = f.f11 * a + f.f12 * b, x[i + 1] = f.f21 * a + f.f22 * b;
    }

    void add(int i, Real q11, Real q12, Real q22) {
        P[i][i] = P[i][i] + q11, P[i + 1][i + 1] = P[i + 1][i + 1] + q22;
        P[i][i + 1] = P[i + 1][i] = P[i][i + 1] + q12;
    }
};

}  // namespace pumafuse
