// How innovations and their variances change with parameters: forward derivatives, carried along by the same pass.
#pragma once
#include "filter.hpp"

namespace pumafuse {

inline constexpr int LANES = 10;  // derivatives that one pass carries: as many as an axis mostly has

// A number with its derivatives.
struct Dual {
    double value = 0.0;
    std::array<double, LANES> d{};

    Dual() = default;
    Dual(double constant) : value(constant) {}

    // f of this number, by its value and its slope there.
    Dual chain(double f, double slope) const {
        Dual found(f);
        for (int i = 0; i < LANES; ++i) found.d[i] = slope * d[i];
        return found;
    }
};

inline double value_of(const Dual& a) { return a.value; }
inline bool is_zero(const Dual& a) {
    return a.value == 0.0 && std::all_of(a.d.begin(), a.d.end(), [](double x) { return x == 0.0; });
}

inline Dual operator-(const Dual& a) { return a.chain(-a.value, -1.0); }
inline Dual operator+(Dual a, const Dual& b) {
    a.value += b.value;
    for (int i = 0; i < LANES; ++i) a.d[i] += b.d[i];
    return a;
}
inline Dual operator-(Dual a, const Dual& b) {
    a.value -= b.value;
    for (int i = 0; i < LANES; ++i) a.d[i] -= b.d[i];
    return a;
}
inline Dual operator*(const Dual& a, const Dual& b) {
    Dual found(a.value * b.value);
    for (int i = 0; i < LANES; ++i) found.d[i] = a.d[i] * b.value + a.value * b.d[i];
    return found;
}
inline Dual operator/(const Dual& a, const Dual& b) {
    Dual found(a.value / b.value);
    for (int i = 0; i < LANES; ++i) found.d[i] = (a.d[i] - found.value * b.d[i]) / b.value;
    return found;
}
inline Dual operator+(Dual a, double b) { a.value += b; return a; }
inline Dual operator+(double a, Dual b) { b.value = a + b.value; return b; }
inline Dual operator-(Dual a, double b) { a.value -= b; return a; }
inline Dual operator-(double a, const Dual& b) { return b.chain(a - b.value, -1.0); }
inline Dual operator*(const Dual& a, double b) { return a.chain(a.value * b, b); }
inline Dual operator*(double a, const Dual& b) { return b.chain(a * b.value, a); }
inline Dual operator/(const Dual& a, double b) { return a.chain(a.value / b, 1.0 / b); }
inline Dual operator/(double a, const Dual& b) { return b.chain(a / b.value, -a / (b.value * b.value)); }

inline Dual exp(const Dual& a) { return a.chain(std::exp(a.value), std::exp(a.value)); }
inline Dual expm1(const Dual& a) { return a.chain(std::expm1(a.value), std::exp(a.value)); }
inline Dual sin(const Dual& a) { return a.chain(std::sin(a.value), std::cos(a.value)); }
inline Dual cos(const Dual& a) { return a.chain(std::cos(a.value), -std::sin(a.value)); }
inline Dual sqrt(const Dual& a) { return a.chain(std::sqrt(a.value), 0.5 / std::sqrt(a.value)); }

// At its best K the covariance does not change with K:
//     d(P+) = (I - K H) dP (I - K H)' + K dR K' - K dH P+ - (K dH P+)'
template <int N>
Vector<N, Dual> joseph_tangent(auto& M, const auto& H, const Along<N, Dual>& along, const Dual& R) {
    Vector<N, Dual> K;
    Vector<N, double> h;
    Matrix<N, double> P;
    for (int i = 0; i < N; ++i) {
        K[i] = along.MH[i] / along.S, h[i] = H[i].value;
        for (int j = 0; j < N; ++j) P[i][j] = M[i][j].value;
    }
    joseph<N, double>(P, h, {P, h, R.value}, R.value);
    std::array<std::array<double, LANES>, N> across{};  // H dP + dH P+
    std::array<double, LANES> along_h = R.d;            // H dP H' + dR
    for (int j = 0; j < N; ++j) {
        for (int i = 0; i < N; ++i)
            for (int k = 0; k < LANES; ++k) across[j][k] += h[i] * M[i][j].d[k];
        for (int k = 0; k < LANES; ++k) along_h[k] += h[j] * across[j][k];
        for (int i = 0; i < N; ++i)
            for (int k = 0; k < LANES; ++k) across[j][k] += H[i].d[k] * P[i][j];
    }
    for (int i = 0; i < N; ++i)
        for (int j = 0; j <= i; ++j) {
            const double a = K[i].value, b = K[j].value, ab = a * b;
            Dual& there = M[i][j];
            there.value = P[i][j];
            for (int k = 0; k < LANES; ++k) there.d[k] += ab * along_h[k] - a * across[j][k] - b * across[i][k];
            M[j][i] = there;
        }
    return K;
}

inline void store(const Fate& fate, Time axis, const Dual& nu, const Dual& S) {
    store(fate, axis, nu.value, S.value);
    for (int i = 0; i < fate.lanes; ++i)
        fate.d_innovation[i * fate.stride + axis] = nu.d[i], fate.d_variance[i * fate.stride + axis] = S.d[i];
}

// All events while outcomes are repeated, with derivatives by as many parameters as `tangents` has lanes.
template <int N>
void linearise(const Filter<N, Dual>& filter, const Table& rows, Time origin, int lanes, double* d_innovation,
               double* d_variance) {
    State<N, Dual> state = filter.at_rest(origin);
    for (Time row = 0; row < rows.events.count; ++row) {
        Fate fate = rows.fate(row);
        fate.d_innovation = d_innovation + row * rows.axes, fate.d_variance = d_variance + row * rows.axes;
        fate.stride = rows.events.count * rows.axes, fate.lanes = lanes;
        filter.step(state, rows[row], fate, true);
    }
}

}  // namespace pumafuse
