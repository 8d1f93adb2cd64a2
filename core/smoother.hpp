// The smoother: what all later measurements say of the residual, carried backward as information. The response is
// known, so that nothing later changes it.
//
// In the deviation delta from the filter's mean the later measurements' likelihood is exp(-½ delta' M delta + eta'
// delta). From the last event backward, M = 0 and eta = 0 at first:
//     over an interval   eta <- F' (I + M Q)^-1 eta,          M <- F' (I + M Q)^-1 M F
//     over an update     eta <- eta + M K nu + H' nu / R,     M <- M + H' H / R
// and with the filter's covariance P the smoothed state is x + P_s eta with P_s = (I + P M)^-1 P. No covariance is
// inverted (the predicted one is singular: some states are known), and P_s is not a difference, as P - P Lambda P would
// be in the Bryson-Frazier form: with a wide prior that loses the error bars altogether. Each product with an inverse
// is a row of updates of rank one: noise enters M as measurements enter P. (Fraser & Potter, "The optimum linear
// smoother as a combination of two optimum linear filters", IEEE Trans. AC 14(4), 1969.)
#pragma once
#include "filter.hpp"

namespace pumafuse {

// How eta changes with the lag and the gain, where these are doubted, moves as eta does: columns of their own.
template <int N, int COLUMNS>
struct Later {
    std::array<Vector<N, double>, COLUMNS> eta{};
    Matrix<N, double> M{};

    void over_interval(const Arm<double>& arm, const Noise<N, double>& noise, double dt, double q, double drift,
                       double scale) {
        over_pair(PLANT, arm.plant.driven_over(dt), q);
        through_noise(OFFSET, std::sqrt(drift * dt));
        int i = DISTURBANCE;
        if (noise.smooth()) over_pair(i, noise.disturbance.driven_over(dt), scale * noise.density), i += 2;
        for (; i < noise.size; ++i) {
            if (noise.reverting[i] == 0.0) continue;
            const double fading = -noise.reverting[i] * dt, left = std::exp(fading);
            through_noise(i, std::sqrt(-noise.variance_of(i, scale) * std::expm1(2.0 * fading)));
            for (int c = 0; c < COLUMNS; ++c) eta[c][i] *= left;
            for (int j = 0; j < N; ++j) M[i][j] *= left, M[j][i] *= left;
        }
    }

    void over_update(const Vector<N, double>& H, const Entry<N>& update) {
        const double nu[] = {update.nu, update.d_nu[LAG], update.d_nu[GAIN]};
        for (int c = 0; c < COLUMNS; ++c)
            for (int i = 0; i < N; ++i) {
                for (int j = 0; j < N; ++j) eta[c][i] += M[i][j] * update.K[j] * nu[c];
                eta[c][i] += H[i] * nu[c] / update.R;
            }
        for (int i = 0; i < N; ++i)
            for (int j = 0; j < N; ++j) M[i][j] += H[i] * H[j] / update.R;
        through_noise(OFFSET, std::sqrt(update.widened));  // what re-acquiring added
    }

    // x <- x + P_s eta and P <- P_s: M = L L' and eta = L y, a column of L after the other is a measurement with unit
    // noise. P_s eta itself would lose a wide prior.
    void smooth(Residual<N, double>& xi) const {
        auto [L, y, rank] = root();
        for (int k = 0; k < rank; ++k) {
            ByDoubt<> d_nu{};
            if constexpr (COLUMNS > 1) std::copy_n(y[k].begin() + 1, DOUBTS, d_nu.begin());
            const Vector<N, double> K = xi.update(L[k], {xi.P, L[k], 1.0}, y[k][0], d_nu, 1.0);
            for (int m = k + 1; m < rank; ++m)
                for (int i = 0; i < N; ++i)
                    for (int c = 0; c < COLUMNS; ++c) y[m][c] -= L[m][i] * K[i] * y[k][c];
        }
    }

  private:
    // Through the noise of the states i and i + 1, as two independent parts, and back over their transition.
    void over_pair(int i, const Driven<double>& f, double density) {
        const double first = std::sqrt(density * f.q11), both = first > 0.0 ? density * f.q12 / first : 0.0;
        through_noise(i, first, both);
        through_noise(i + 1, std::sqrt(std::max(density * f.q22 - both * both, 0.0)));
        for (int c = 0; c < COLUMNS; ++c) {
            const double p = eta[c][i], v = eta[c][i + 1];
            eta[c][i] = f.f11 * p + f.f21 * v, eta[c][i + 1] = f.f12 * p + f.f22 * v;
        }
        move_pair<N, double>(M, i, f.f11, f.f21, f.f12, f.f22);
    }

    // Unit noise that enters state i by `first` and the next one by `second`, G: M <- M - M G G' M / S, S = 1 + G' M G.
    void through_noise(int i, double first, double second = 0.0) {
        if (first == 0.0 && second == 0.0) return;
        const int next = second != 0.0 ? i + 1 : i;
        Vector<N, double> MG;
        for (int j = 0; j < N; ++j) MG[j] = first * M[j][i] + second * M[j][next];
        const double S = 1.0 + first * MG[i] + second * MG[next];
        std::array<double, COLUMNS> seen{};
        for (int c = 0; c < COLUMNS; ++c) seen[c] = first * eta[c][i] + second * eta[c][next];
        for (int j = 0; j < N; ++j) {
            const double K = MG[j] / S;
            for (int c = 0; c < COLUMNS; ++c) eta[c][j] -= K * seen[c];
            for (int l = 0; l <= j; ++l) M[j][l] = M[l][j] = M[j][l] - K * MG[l];
        }
    }

    struct Root {
        Matrix<N, double> L{};  // its rows are the columns
        std::array<std::array<double, COLUMNS>, N> y{};
        int rank = 0;
    };

    // The state with the largest share of its own information left comes first: M says nothing of some states, or of
    // their differences, and in another order a pivot of rounding would be divided by.
    Root root() const {
        constexpr double NOTHING = 1e-15;  // of a pivot, below which it is rounding
        Root result;
        auto& [L, y, rank] = result;
        Vector<N, double> left;
        for (int i = 0; i < N; ++i) left[i] = M[i][i];
        for (int& k = rank; k < N; ++k) {
            int pivot = -1;
            double most = NOTHING;
            for (int i = 0; i < N; ++i)
                if (left[i] > most * M[i][i]) pivot = i, most = left[i] / M[i][i];
            if (pivot < 0) break;
            L[k][pivot] = std::sqrt(left[pivot]), left[pivot] = 0.0;
            for (int c = 0; c < COLUMNS; ++c) {
                y[k][c] = eta[c][pivot];
                for (int m = 0; m < k; ++m) y[k][c] -= y[m][c] * L[m][pivot];
                y[k][c] /= L[k][pivot];
            }
            for (int i = 0; i < N; ++i) {
                if (!(left[i] > 0.0)) continue;
                L[k][i] = M[i][pivot];
                for (int m = 0; m < k; ++m) L[k][i] -= L[m][i] * L[m][pivot];
                L[k][i] /= L[k][pivot], left[i] -= L[k][i] * L[k][i];
            }
        }
        return result;
    }
};

// The filter's own estimate of an axis at an instant.
template <int N>
struct Filtered {
    double r;
    ByDoubt<> doubt;  // of r
    double way;       // of r over the coming period [m], where an unseen lag counts
    Residual<N, double> residual;
};

// One axis backward, from its filtered states at the estimates.
template <int COLUMNS, int N>
void smooth_axis(const Filter<N>& filter, Time a, const std::vector<Entry<N>>& history,
                 std::vector<Filtered<N>>& at, Time origin, Time n, const Time* times, double* outputs) {
    const Time A = filter.size();
    const AxisModel<N, double>& axis = filter.axes[a];
    Later<N, COLUMNS> later;
    Time k = n - 1;
    const auto smooth_back = [&] {  // estimate k, and on to the one before
        double numbers[PF_OUTPUTS];
        auto& [r, doubt, way, residual] = at[k * A + a];
        later.smooth(residual);
        Filter<N>::describe(axis, r, doubt, residual, numbers);
        axis.widen(way, numbers);
        for (int i = 0; i < PF_OUTPUTS; ++i) outputs[(i * A + a) * n + k] = numbers[i];
        --k;
    };
    while (k >= 0 && (history.empty() || times[k] >= history.back().time)) smooth_back();  // nothing is later
    for (auto entry = history.rbegin(); entry != history.rend(); ++entry) {
        if (entry->sensor != NOBODY) later.over_update(filter.H[entry->sensor * A + a], *entry);
        Time from = entry->time;
        const auto back_to = [&](Time to) {
            const double dt = double(std::exchange(from, to) - to) / 1e9;
            if (dt > 0.0) later.over_interval(axis.arm, axis.noise, dt, entry->q, entry->drift, entry->scale);
        };
        const Time before = entry + 1 != history.rend() ? entry[1].time : origin;
        for (; k >= 0 && times[k] >= before; smooth_back()) back_to(times[k]);
        back_to(before);
    }
}

// All events, and at each of n times what all measurements say: forward, keeping what happened and the states at the
// estimates, then backward, axis by axis.
template <int N>
void run_smoothed(const Filter<N>& filter, State<N, double>& state, const Table& rows, Time n, const Time* times,
                  double* outputs) {
    const Time A = filter.size(), count = rows.events.count, origin = state.axes.front().response.time.ns;
    typename Filter<N>::History history(A);
    std::vector<Filtered<N>> at;
    for (auto& entries : history) entries.reserve(count);
    at.reserve(A * n);
    Time row = 0;
    for (Time k = 0; k <= n; ++k) {
        for (; row < count && (k == n || rows.events.time[row] <= times[k]); ++row)
            filter.step(state, rows[row], rows.fate(row), false, &history);
        for (Time a = 0; a < A && k < n; ++a) {
            AxisState<N, double> now = state.axes[a];
            filter.predict(now, a, {times[k], 0.0});
            const AxisModel<N, double>& axis = filter.axes[a];
            const double way = axis.unseen > 0.0 ? filter.way_ahead(now, a, rows, row, count, times[k]) : 0.0;
            at.push_back({now.response.position(axis.arm), axis.doubt(now.response), way, now.residual});
        }
    }
    for (Time a = 0; a < A; ++a) {
        const auto smooth = filter.axes[a].noise.doubted ? smooth_axis<1 + DOUBTS, N> : smooth_axis<1, N>;
        smooth(filter, a, history[a], at, origin, n, times, outputs);
    }
}

}  // namespace pumafuse
