// How innovations and their variances change with parameters: forward derivatives, carried along by the same pass.
#pragma once
#include "filter.hpp"

namespace pumafuse {

// Two numbers that a processor takes at once. A loop over single ones is not joined to these by itself.
#if defined(_MSC_VER) && !defined(__clang__)
struct Pair {
    double of[2];

    double& operator[](int i) { return of[i]; }
    double operator[](int i) const { return of[i]; }
    friend Pair operator+(Pair a, Pair b) { return {a[0] + b[0], a[1] + b[1]}; }
    friend Pair operator-(Pair a, Pair b) { return {a[0] - b[0], a[1] - b[1]}; }
    friend Pair operator*(Pair a, double b) { return {a[0] * b, a[1] * b}; }
    friend Pair operator*(double a, Pair b) { return {a * b[0], a * b[1]}; }
    friend Pair operator/(Pair a, double b) { return {a[0] / b, a[1] / b}; }
    Pair& operator+=(Pair b) { return *this = *this + b; }
    Pair& operator-=(Pair b) { return *this = *this - b; }
};
#else
typedef double Pair __attribute__((vector_size(16)));
#endif

// A number with L derivatives, an even count.
template <int L>
struct Dual {
    static constexpr int PAIRS = L / 2;

    double value = 0.0;
    std::array<Pair, PAIRS> d{};

    Dual() = default;
    Dual(double constant) : value(constant) {}

    double derivative(int i) const { return d[i / 2][i % 2]; }

    // f of this number, by its value and its slope there.
    Dual chain(double f, double slope) const {
        Dual result(f);
        for (int i = 0; i < PAIRS; ++i) result.d[i] = slope * d[i];
        return result;
    }

    friend double value_of(const Dual& a) { return a.value; }
    friend bool is_zero(const Dual& a) {
        return a.value == 0.0 && std::all_of(a.d.begin(), a.d.end(), [](Pair x) { return x[0] == 0.0 && x[1] == 0.0; });
    }

    friend Dual operator-(const Dual& a) { return a.chain(-a.value, -1.0); }
    friend Dual operator+(Dual a, const Dual& b) {
        a.value += b.value;
        for (int i = 0; i < PAIRS; ++i) a.d[i] += b.d[i];
        return a;
    }
    friend Dual operator-(Dual a, const Dual& b) {
        a.value -= b.value;
        for (int i = 0; i < PAIRS; ++i) a.d[i] -= b.d[i];
        return a;
    }
    friend Dual operator*(const Dual& a, const Dual& b) {
        Dual result(a.value * b.value);
        for (int i = 0; i < PAIRS; ++i) result.d[i] = a.d[i] * b.value + a.value * b.d[i];
        return result;
    }
    friend Dual operator/(const Dual& a, const Dual& b) {
        Dual result(a.value / b.value);
        for (int i = 0; i < PAIRS; ++i) result.d[i] = (a.d[i] - result.value * b.d[i]) / b.value;
        return result;
    }
    friend Dual operator+(Dual a, double b) { a.value += b; return a; }
    friend Dual operator+(double a, Dual b) { b.value = a + b.value; return b; }
    friend Dual operator-(Dual a, double b) { a.value -= b; return a; }
    friend Dual operator-(double a, const Dual& b) { return b.chain(a - b.value, -1.0); }
    friend Dual operator*(const Dual& a, double b) { return a.chain(a.value * b, b); }
    friend Dual operator*(double a, const Dual& b) { return b.chain(a * b.value, a); }
    friend Dual operator/(const Dual& a, double b) { return a.chain(a.value / b, 1.0 / b); }
    friend Dual operator/(double a, const Dual& b) { return b.chain(a / b.value, -a / (b.value * b.value)); }

    friend Dual exp(const Dual& a) { return a.chain(std::exp(a.value), std::exp(a.value)); }
    friend Dual expm1(const Dual& a) { return a.chain(std::expm1(a.value), std::exp(a.value)); }
    friend Dual sin(const Dual& a) { return a.chain(std::sin(a.value), std::cos(a.value)); }
    friend Dual cos(const Dual& a) { return a.chain(std::cos(a.value), -std::sin(a.value)); }
    friend Dual sqrt(const Dual& a) { return a.chain(std::sqrt(a.value), 0.5 / std::sqrt(a.value)); }
};

// At its best K the covariance does not change with K:
//     d(P+) = (I - K H) dP (I - K H)' + K dR K' - K dH P+ - (K dH P+)'
// with (I - K H) dP (I - K H)' = dP - K H dP - (K H dP)' + K H dP H' K'. `projection` has H dP + dH P and dS.
template <int N, int L>
Vector<N, Dual<L>> joseph_tangent(auto& M, const auto& H, const Projection<N, Dual<L>>& projection, const Dual<L>& R) {
    constexpr int PAIRS = Dual<L>::PAIRS;
    Vector<N, Dual<L>> K;
    Vector<N, double> h;
    Matrix<N, double> P;
    std::array<Pair, PAIRS> moved{};  // dH K
    for (int i = 0; i < N; ++i) {
        K[i] = projection.MH[i] / projection.S, h[i] = H[i].value;
        for (int j = 0; j < N; ++j) P[i][j] = M[i][j].value;
        for (int k = 0; k < PAIRS; ++k) moved[k] += H[i].d[k] * K[i].value;
    }
    joseph<N, double>(P, h, {P, h, R.value}, R.value);
    std::array<Pair, PAIRS> along_h;               // H dP H' + dR
    std::array<std::array<Pair, PAIRS>, N> across; // H dP + dH P+, less half of K along_h
    for (int k = 0; k < PAIRS; ++k) along_h[k] = projection.S.d[k] - 2.0 * projection.S.value * moved[k];
    for (int i = 0; i < N; ++i)
        for (int k = 0; k < PAIRS; ++k)
            across[i][k] = projection.MH[i].d[k] - projection.MH[i].value * moved[k] - 0.5 * K[i].value * along_h[k];
    for (int i = 0; i < N; ++i)
        for (int j = 0; j <= i; ++j) {
            Dual<L>& entry = M[i][j];
            entry.value = P[i][j];
            for (int k = 0; k < PAIRS; ++k) entry.d[k] -= K[i].value * across[j][k] + K[j].value * across[i][k];
            M[j][i] = entry;
        }
    return K;
}

template <int L>
void store(const Fate& fate, Time axis, const Dual<L>& nu, const Dual<L>& S) {
    store(fate, axis, nu.value, S.value);
    for (int i = 0; i < fate.lanes; ++i) {
        fate.d_innovation[i * fate.stride + axis] = nu.derivative(i);
        fate.d_variance[i * fate.stride + axis] = S.derivative(i);
    }
}

// All events while outcomes are repeated, with derivatives by as many parameters as `tangents` has lanes.
template <int N, int L>
void linearise(const Filter<N, Dual<L>>& filter, const Table& rows, Time origin, int lanes, double* d_innovation,
               double* d_variance) {
    State<N, Dual<L>> state = filter.at_rest(origin);
    for (Time row = 0; row < rows.events.count; ++row) {
        Fate fate = rows.fate(row);
        fate.d_innovation = d_innovation + row * rows.axes, fate.d_variance = d_variance + row * rows.axes;
        fate.stride = rows.events.count * rows.axes, fate.lanes = lanes;
        filter.step(state, rows[row], fate, true);
    }
}

}  // namespace pumafuse
