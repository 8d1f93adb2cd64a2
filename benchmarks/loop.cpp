// The loops that one would write by hand: the filter of pumafuse on the same table of events, with nothing around it.
//
// For each axis a state of position, rate, offset and bias, predicted in closed form, updated in Joseph form.
// What the gates decided is given. At each of some times `filter` and `as_live` write what pumafuse.fuse gives out, and
// `smooth` what all measurements say of position and offset.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

namespace {

constexpr int N = 4;  // position, rate, offset, bias
enum Code : uint8_t { FUSED = 0, REJECTED = 1, REACQUIRED = 2 };
constexpr int COMMAND = -1;
using Vector = double[N];
using Matrix = double[N][N];

struct Axis {  // as peers.py packs it; a plant of first order has rate, one of second order omega and zeta < 1
    double order, rate, omega, zeta, slope, intercept, decay, period;
    double input_noise, drift, maneuver_noise, maneuver_drift, start, offset_sd, states, bias_sd;
};

struct Run {  // as peers.py packs it
    int64_t axes, rows, estimates, origin;
    const Axis* axis;
    const double *scale, *sd;
    const int64_t *biased, *time;
    const int16_t* source;
    const int64_t* stamp;
    const double* value;
    const uint8_t* outcome;
    const int64_t* times;
    double *innovation, *innovation_sd, *outputs;
};

struct Transition {
    double f11, f12, f21, f22, q11, q12, q22, e1, e2, left;
};

Transition transition(const Axis& a, double t) {
    const double left = std::exp(-a.decay * t);
    if (a.order == 1.0) {
        const double f = std::exp(-a.rate * t);
        return {f, 0, 0, 0, 0.5 * a.rate * (1 - f * f), 0, 0, a.rate * (left - f) / (a.rate - a.decay), 0, left};
    }
    const double w2 = a.omega * a.omega, s = a.zeta * a.omega, b = a.omega * std::sqrt(1 - a.zeta * a.zeta);
    const double E = std::exp(-s * t), sine = std::sin(b * t), cosine = std::cos(b * t);
    const double g = E * sine / b, g_rate = E * cosine - s * g;
    const double turning = 2 * s * (1 - E * E * (cosine * cosine - sine * sine)) + 4 * b * E * E * sine * cosine;
    const double power = ((1 - E * E) / (2 * s) - turning / (4 * w2)) / (2 * b * b);  // ∫ g²
    const double q11 = w2 * w2 * power, q12 = 0.5 * w2 * w2 * g * g;
    const double h = (left - g_rate - (2 * s - a.decay) * g) / (a.decay * a.decay - 2 * s * a.decay + w2);
    return {g_rate + 2 * s * g, g, -w2 * g, g_rate, q11, q12, w2 * q11 + 2 * s * q12 + w2 * w2 * g * g_rate,
            w2 * h, w2 * (g - a.decay * h), left};
}

// M ← F M Fᵀ where F moves the first two states.
void move(Matrix& M, int n, double f11, double f12, double f21, double f22) {
    for (int j = 0; j < n; ++j) {
        const double p = M[0][j], v = M[1][j];
        M[0][j] = f11 * p + f12 * v, M[1][j] = f21 * p + f22 * v;
    }
    for (int i = 0; i < n; ++i) {
        const double p = M[i][0], v = M[i][1];
        M[i][0] = p * f11 + v * f12, M[i][1] = p * f21 + v * f22;
    }
}

// M Hᵀ and S = H M Hᵀ + R.
double along(const Matrix& M, int n, const Vector& H, double R, Vector& MH) {
    double S = R;
    for (int i = 0; i < n; ++i) {
        MH[i] = 0;
        for (int j = 0; j < n; ++j) MH[i] += M[i][j] * H[j];
        S += H[i] * MH[i];
    }
    return S;
}

// K = M Hᵀ / S and M ← (I − K H) M (I − K H)ᵀ + K R Kᵀ.
void joseph(Matrix& M, int n, const Vector& H, double R, const Vector& MH, double S, Vector& K) {
    Vector WH;
    for (int i = 0; i < n; ++i) K[i] = MH[i] / S;
    for (int i = 0; i < n; ++i) {  // W = (I − K H) M
        WH[i] = 0;
        for (int j = 0; j < n; ++j) M[i][j] -= K[i] * MH[j], WH[i] += M[i][j] * H[j];
    }
    for (int i = 0; i < n; ++i)  // W (I − K H)ᵀ + K R Kᵀ
        for (int j = 0; j < n; ++j) M[i][j] += (K[i] * R - WH[i]) * K[j];
}

struct State {
    int64_t clock = 0;
    int n = 0;
    double u = 0, step = 0, error = 0, noise = 0, drift = 0;
    Vector x = {};
    Matrix P = {};

    State() = default;

    State(const Axis& a, int64_t origin) : clock(origin), n(int(a.states)) {
        noise = a.input_noise * a.input_noise, drift = a.drift * a.drift;
        P[2][2] = a.offset_sd * a.offset_sd;
        if (n == N) P[3][3] = a.bias_sd * a.bias_sd;
    }

    void predict(const Axis& a, int64_t time) {
        if (time <= clock) return;
        const double dt = double(time - clock) / 1e9, gap = x[0] - u, rate = x[1];
        const Transition f = transition(a, dt);
        x[0] = u + f.f11 * gap + f.f12 * rate + f.e1 * error;
        x[1] = f.f21 * gap + f.f22 * rate + f.e2 * error;
        error *= f.left;
        move(P, n, f.f11, f.f12, f.f21, f.f22);
        P[0][0] += noise * f.q11, P[0][1] += noise * f.q12, P[1][0] += noise * f.q12, P[1][1] += noise * f.q22;
        P[2][2] += drift * dt;
        clock = time;
    }

    void command(const Axis& a, double value) {
        const double now = value - a.start - u, maneuver = std::fabs(now - step) / a.period;
        error += (a.slope * std::fabs(now) / a.period + a.intercept - 1) * now;
        u += now, step = now;
        noise = a.input_noise * a.input_noise + std::pow(a.maneuver_noise * maneuver, 2);
        drift = a.drift * a.drift + std::pow(a.maneuver_drift * maneuver, 2);
    }

    // By how much the offset widened.
    double update(const Vector& H, double z, double R, Code outcome, double& nu, double& sd, Vector& K) {
        double widened = 0;
        nu = z;
        for (int i = 0; i < n; ++i) nu -= H[i] * x[i];
        if (outcome == REACQUIRED) P[2][2] += widened = nu * nu / (H[0] * H[0]);
        Vector PH;
        const double S = along(P, n, H, R, PH);
        sd = std::sqrt(S);
        if (outcome == REJECTED) return 0;
        joseph(P, n, H, R, PH, S, K);
        for (int i = 0; i < n; ++i) x[i] += K[i] * nu;
        return widened;
    }

    double position() const { return x[0] + x[2]; }
    double variance() const { return std::max(P[0][0] + 2 * P[0][2] + P[2][2], 0.0); }
};

struct Entry {  // what the smoother needs to know of an event: the interval before it, and the update if it is one
    int64_t time, row = -1;
    double noise, drift, R = 0, widened = 0;
    Vector K = {};
};

void observe(const Run& run, int64_t row, int64_t a, Vector& H) {
    const int s = run.source[row];
    H[0] = H[2] = run.scale[s], H[1] = 0, H[3] = run.biased[s * run.axes + a] ? 1 : 0;
}

// One axis of one row; what is to be known of it later is appended to `history` if there is one.
void event(const Run& run, int64_t row, int64_t a, State& state, std::vector<Entry>* history = nullptr) {
    const int64_t at = row * run.axes + a;
    const Axis& axis = run.axis[a];
    if (run.outcome[at] > REACQUIRED) return;
    state.predict(axis, run.time[row]);
    Entry kept{.time = run.time[row], .noise = state.noise, .drift = state.drift};
    if (run.source[row] == COMMAND) {
        state.command(axis, run.value[at]);
    } else {
        Vector H;
        observe(run, row, a, H);
        const double sd = run.sd[run.source[row] * run.axes + a], z = run.value[at] - H[0] * axis.start;
        const Code outcome = Code(run.outcome[at]);
        kept.R = sd * sd;
        kept.widened = state.update(H, z, kept.R, outcome, run.innovation[at], run.innovation_sd[at], kept.K);
        if (outcome != REJECTED) kept.row = row;
    }
    if (history) history->push_back(kept);
}

std::vector<State> at_rest(const Run& run) {
    std::vector<State> state;
    for (int64_t a = 0; a < run.axes; ++a) state.emplace_back(run.axis[a], run.origin);
    return state;
}

// Every axis at an instant; rows from `pending` on are not in the state yet.
void estimate(const Run& run, const std::vector<State>& state, int64_t pending, int64_t n) {
    const int64_t time = run.times[n];
    for (int64_t a = 0; a < run.axes; ++a) {
        const Axis& axis = run.axis[a];
        State now = state[a];
        now.predict(axis, time);
        // The mean velocity over the coming period, by the commands that are given and act within it.
        State later = now;
        std::memset(later.P, 0, sizeof later.P);
        const int64_t until = time + std::llrint(axis.period * 1e9);
        for (int64_t k = pending; k < run.rows && run.time[k] <= until; ++k)
            if (run.source[k] == COMMAND && run.outcome[k * run.axes + a] == FUSED && run.stamp[k] <= time) {
                later.predict(axis, run.time[k]);
                later.command(axis, run.value[k * run.axes + a]);
            }
        later.predict(axis, until);
        const Transition f = transition(axis, double(until - time) / 1e9);
        const double p = f.f11 - 1, v = f.f12, T = axis.period;
        const double own = p * p * now.P[0][0] + 2 * p * v * now.P[0][1] + v * v * now.P[1][1];
        const double found[] = {now.position() + axis.start, std::sqrt(now.variance()),
                                (later.position() - now.position()) / T, std::sqrt(own + later.variance()) / T,
                                now.x[2], std::sqrt(now.P[2][2])};
        for (int k = 0; k < 6; ++k) run.outputs[(k * run.axes + a) * run.estimates + n] = found[k];
    }
}

// What later measurements say of the deviation from the filter's mean: exp(−½ δᵀ M δ + etaᵀ δ).
struct Later {
    int n;
    Vector eta = {};
    Matrix M = {};

    void through_noise(const Vector& G) {  // of unit variance that enters along G
        Vector MG, K;
        double seen = 0;
        for (int i = 0; i < n; ++i) seen += G[i] * eta[i];
        const double S = along(M, n, G, 1, MG);
        joseph(M, n, G, 1, MG, S, K);
        for (int i = 0; i < n; ++i) eta[i] -= K[i] * seen;
    }

    void over_interval(const Axis& a, double dt, double noise, double drift) {
        const Transition f = transition(a, dt);
        const double first = std::sqrt(noise * f.q11), both = first > 0 ? noise * f.q12 / first : 0;
        through_noise({first, both, 0, 0});
        if (a.order == 2.0) through_noise({0, std::sqrt(std::max(noise * f.q22 - both * both, 0.0)), 0, 0});
        through_noise({0, 0, std::sqrt(drift * dt), 0});
        const double p = eta[0], v = eta[1];
        eta[0] = f.f11 * p + f.f21 * v, eta[1] = f.f12 * p + f.f22 * v;
        move(M, n, f.f11, f.f21, f.f12, f.f22);
    }

    void over_update(const Vector& H, const Entry& entry, double nu) {
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < n; ++j) eta[i] += M[i][j] * entry.K[j] * nu;
            eta[i] += H[i] * nu / entry.R;
        }
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) M[i][j] += H[i] * H[j] / entry.R;
        if (entry.widened > 0) through_noise({0, 0, std::sqrt(entry.widened), 0});
    }

    // x + P_s eta and P_s = (I + P M)⁻¹ P: with M = L Lᵀ, a column of L after the other is a measurement with unit noise.
    // P_s eta itself would lose the wide prior of a bias. The largest share of its information left comes first.
    void smooth(State& state) const {
        Matrix L = {};  // its rows are the columns
        Vector left, y = {}, PH, K;
        for (int i = 0; i < n; ++i) left[i] = M[i][i];
        for (int k = 0; k < n; ++k) {
            int p = 0;
            for (int i = 1; i < n; ++i)
                if (left[i] * M[p][p] > left[p] * M[i][i]) p = i;
            if (left[p] <= 1e-15 * M[p][p]) break;  // the rest is rounding
            L[k][p] = std::sqrt(left[p]), left[p] = 0, y[k] = eta[p];
            for (int m = 0; m < k; ++m) y[k] -= y[m] * L[m][p];
            y[k] /= L[k][p];
            for (int i = 0; i < n; ++i) {
                if (left[i] <= 0) continue;
                L[k][i] = M[i][p];
                for (int m = 0; m < k; ++m) L[k][i] -= L[m][i] * L[m][p];
                L[k][i] /= L[k][p], left[i] -= L[k][i] * L[k][i];
            }
        }
        for (int k = 0; k < n; ++k) {
            const double S = along(state.P, n, L[k], 1, PH);
            joseph(state.P, n, L[k], 1, PH, S, K);
            for (int i = 0; i < n; ++i) state.x[i] += K[i] * y[k];
            for (int m = k + 1; m < n; ++m)
                for (int i = 0; i < n; ++i) y[m] -= L[m][i] * K[i] * y[k];
        }
    }
};

}  // namespace

extern "C" void filter(const Run& run) {
    std::vector<State> state = at_rest(run);
    int64_t row = 0;
    for (int64_t n = 0; n <= run.estimates; ++n) {
        for (; row < run.rows && (n == run.estimates || run.time[row] <= run.times[n]); ++row)
            for (int64_t a = 0; a < run.axes; ++a) event(run, row, a, state[a]);
        if (n < run.estimates) estimate(run, state, row, n);
    }
}

// Rows in the order of their arrival, `queue`. The state before each row is kept in a ring of `places`: where one comes
// late, the loop goes back to it and runs all rows since then again.
extern "C" void as_live(const Run& run, const int64_t* arrival, const int64_t* queue, int64_t places) {
    std::vector<State> state = at_rest(run), ring(places * run.axes);
    std::vector<char> arrived(run.rows, 0);
    int64_t due = 0, done = 0;
    for (int64_t n = 0; n <= run.estimates; ++n) {
        const int64_t until = n < run.estimates ? run.times[n] : std::numeric_limits<int64_t>::max();
        int64_t row = done;
        for (; due < run.rows && arrival[queue[due]] <= until; ++due) {
            arrived[queue[due]] = 1;
            row = std::min(row, queue[due]);
        }
        if (row < done) std::copy_n(&ring[row % places * run.axes], run.axes, state.begin());
        while (done < run.rows && run.time[done] <= until) ++done;
        for (; row < done; ++row) {
            std::copy_n(state.begin(), run.axes, &ring[row % places * run.axes]);
            for (int64_t a = 0; a < run.axes && arrived[row]; ++a) event(run, row, a, state[a]);
        }
        if (n < run.estimates) estimate(run, state, done, n);
    }
}

// One axis after the other: forward, keeping what happened and the states at the estimates, then backward.
extern "C" void smooth(const Run& run) {
    for (int64_t a = 0; a < run.axes; ++a) {
        const Axis& axis = run.axis[a];
        State state(axis, run.origin);
        std::vector<Entry> history;
        std::vector<State> at(run.estimates);
        history.reserve(run.rows);
        int64_t row = 0;
        for (int64_t n = 0; n <= run.estimates; ++n) {
            for (; row < run.rows && (n == run.estimates || run.time[row] <= run.times[n]); ++row)
                event(run, row, a, state, &history);
            if (n == run.estimates) break;
            at[n] = state;
            at[n].predict(axis, run.times[n]);
        }
        Later later{state.n};
        int64_t n = run.estimates - 1;
        while (n >= 0 && (history.empty() || run.times[n] >= history.back().time)) --n;
        for (int64_t k = int64_t(history.size()) - 1; k >= 0; --k) {
            const Entry& entry = history[k];
            const int64_t before = k > 0 ? history[k - 1].time : run.origin;
            if (entry.row >= 0) {
                Vector H;
                observe(run, entry.row, a, H);
                later.over_update(H, entry, run.innovation[entry.row * run.axes + a]);
            }
            int64_t here = entry.time;
            for (; n >= 0 && run.times[n] >= before; --n) {
                later.over_interval(axis, double(here - run.times[n]) / 1e9, entry.noise, entry.drift);
                later.smooth(at[n]);
                here = run.times[n];
            }
            if (here > before) later.over_interval(axis, double(here - before) / 1e9, entry.noise, entry.drift);
        }
        for (n = 0; n < run.estimates; ++n) {
            const State& s = at[n];
            const double found[] = {s.position() + axis.start, std::sqrt(s.variance()), s.x[2], std::sqrt(s.P[2][2])};
            for (int k = 0; k < 4; ++k) run.outputs[(k * run.axes + a) * run.estimates + n] = found[k];
        }
    }
}
