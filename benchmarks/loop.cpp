// The loop that one would write by hand: the filter of pumafuse on the same table of events, without anything around it.
//
// For each axis a state of position, rate, offset and bias, predicted by closed-form transitions, updated in Joseph form.
// What the gates decided is given. At each of some times it writes what pumafuse.fuse gives out.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace {

constexpr int N = 4;  // position, rate, offset, bias
enum Code : uint8_t { FUSED = 0, REJECTED = 1, REACQUIRED = 2 };
constexpr int COMMAND = -1;

struct Axis {  // as peers.py packs it; a plant of first order has rate, one of second order omega and zeta < 1
    double order, rate, omega, zeta, slope, intercept, decay, period;
    double input_noise, drift, maneuver_noise, maneuver_drift, start, offset_sd, states, bias_sd;
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

struct State {
    int64_t clock;
    int n;
    double u = 0, step = 0, error = 0, noise, drift;
    double x[N] = {}, P[N][N] = {};

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
        for (int j = 0; j < n; ++j) {  // P ← F P
            const double p = P[0][j], v = P[1][j];
            P[0][j] = f.f11 * p + f.f12 * v, P[1][j] = f.f21 * p + f.f22 * v;
        }
        for (int i = 0; i < n; ++i) {  // P ← P Fᵀ
            const double p = P[i][0], v = P[i][1];
            P[i][0] = p * f.f11 + v * f.f12, P[i][1] = p * f.f21 + v * f.f22;
        }
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

    void update(const double (&H)[N], double z, double R, Code outcome, double& nu, double& sd) {
        nu = z;
        for (int i = 0; i < n; ++i) nu -= H[i] * x[i];
        if (outcome == REACQUIRED) P[2][2] += nu * nu / (H[0] * H[0]);
        double PH[N], K[N], WH[N], S = R;
        for (int i = 0; i < n; ++i) {
            PH[i] = 0;
            for (int j = 0; j < n; ++j) PH[i] += P[i][j] * H[j];
            S += H[i] * PH[i];
        }
        sd = std::sqrt(S);
        if (outcome == REJECTED) return;
        for (int i = 0; i < n; ++i) K[i] = PH[i] / S, x[i] += K[i] * nu;
        for (int i = 0; i < n; ++i) {  // W = (I − K H) P
            WH[i] = 0;
            for (int j = 0; j < n; ++j) P[i][j] -= K[i] * PH[j], WH[i] += P[i][j] * H[j];
        }
        for (int i = 0; i < n; ++i)  // W (I − K H)ᵀ + K R Kᵀ
            for (int j = 0; j < n; ++j) P[i][j] += (K[i] * R - WH[i]) * K[j];
    }

    double variance() const { return std::max(P[0][0] + 2 * P[0][2] + P[2][2], 0.0); }
};

}  // namespace

extern "C" void filter_events(int axes, const Axis* axis, const double* scale, const double* sd, const int64_t* biased,
                              int64_t origin, int64_t rows, const int64_t* time, const int16_t* source,
                              const int64_t* stamp, const double* value, const uint8_t* outcome, double* innovation,
                              double* innovation_sd, int64_t estimates, const int64_t* times, double* outputs) {
    std::vector<State> state;
    for (int a = 0; a < axes; ++a) state.emplace_back(axis[a], origin);
    int64_t row = 0;
    for (int64_t n = 0; n <= estimates; ++n) {
        for (; row < rows && (n == estimates || time[row] <= times[n]); ++row)
            for (int a = 0; a < axes; ++a) {
                const int64_t at = row * axes + a;
                if (outcome[at] > REACQUIRED) continue;
                state[a].predict(axis[a], time[row]);
                if (source[row] == COMMAND) {
                    state[a].command(axis[a], value[at]);
                    continue;
                }
                const int s = source[row], as = s * axes + a;
                const double H[N] = {scale[s], 0, scale[s], biased[as] ? 1.0 : 0.0};
                state[a].update(H, value[at] - scale[s] * axis[a].start, sd[as] * sd[as], Code(outcome[at]),
                                innovation[at], innovation_sd[at]);
            }
        for (int a = 0; a < axes && n < estimates; ++a) {
            State now = state[a];
            now.predict(axis[a], times[n]);
            // The mean velocity over the coming period, by the commands that are given and act within it.
            State later = now;
            for (auto& line : later.P) std::fill(line, line + N, 0.0);
            const int64_t until = times[n] + std::llrint(axis[a].period * 1e9);
            for (int64_t k = row; k < rows && time[k] <= until; ++k)
                if (source[k] == COMMAND && outcome[k * axes + a] == FUSED && stamp[k] <= times[n]) {
                    later.predict(axis[a], time[k]);
                    later.command(axis[a], value[k * axes + a]);
                }
            later.predict(axis[a], until);
            const Transition f = transition(axis[a], double(until - times[n]) / 1e9);
            const double p = f.f11 - 1, v = f.f12, T = axis[a].period;
            const double own = p * p * now.P[0][0] + 2 * p * v * now.P[0][1] + v * v * now.P[1][1];
            const double found[] = {now.x[0] + now.x[2] + axis[a].start, std::sqrt(now.variance()),
                                    (later.x[0] + later.x[2] - now.x[0] - now.x[2]) / T,
                                    std::sqrt(own + later.variance()) / T, now.x[2], std::sqrt(now.P[2][2])};
            for (int k = 0; k < 6; ++k) outputs[(k * axes + a) * estimates + n] = found[k];
        }
    }
}
