// The search for an arm: responses of many arms against measurements, under the noise that the best of them leaves.
#pragma once
#include <cstring>

#include "interface.hpp"
#include "residual.hpp"

namespace pumafuse {

// Makes columns of numbers, one for each measurement, independent and of variance 1: the innovations of a filter for a
// random walk, a disturbance and white noise, over their standard deviations. A measurement of infinite variance is
// none.
class Whitening {
  public:
    double log_determinant = 0.0;  // of the covariance of what was measured

    Whitening(const pf_noise& noise, Time n, const Time* time, const double* variance) : steps(n) {
        const double variance_d = square(noise.disturbance_sd);
        const bool smooth = noise.smoothness > 1.0, disturbed = variance_d > 0.0;
        const double lambda = disturbed ? (smooth ? std::sqrt(3.0) : 1.0) / noise.disturbance_time : 0.0;
        const Plant<double> plant = smooth && disturbed ? Plant<double>(lambda, 1.0, 0.0) : Plant<double>();
        const double density = 4.0 * variance_d / std::max(lambda, 1e-300);
        double P[3][3] = {{square(noise.offset_sd), 0.0, 0.0}, {0.0, variance_d, 0.0}, {0.0, 0.0, 0.0}};
        if (smooth) P[2][2] = square(lambda) * variance_d;
        for (Time k = 0; k < n; ++k) {
            Step& step = steps[k];
            if (const double dt = k > 0 ? double(time[k] - time[k - 1]) / 1e9 : 0.0; dt > 0.0) {
                P[0][0] += square(noise.walk) * dt;
                if (smooth && disturbed) {
                    const Driven<double>& f = plant.driven_over(dt);
                    step = {f.f11, f.f12, f.f21, f.f22};
                    predict(P, step, density * f.q11, density * f.q12, density * f.q22);
                } else if (disturbed) {
                    step.f11 = std::exp(-lambda * dt);
                    predict(P, step, -std::expm1(-2.0 * lambda * dt) * variance_d, 0.0, 0.0);
                }
            }
            if (!std::isfinite(variance[k])) continue;
            double seen[3];
            for (int i = 0; i < 3; ++i) seen[i] = P[i][0] + P[i][1];
            const double S = seen[0] + seen[1] + variance[k];
            step.root = 1.0 / std::sqrt(S), log_determinant += std::log(S);
            for (int i = 0; i < 3; ++i) step.gain[i] = seen[i] / S;
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) P[i][j] -= step.gain[i] * seen[j];
        }
    }

    void operator()(const double* column, double* whitened) const {
        double offset = 0.0, disturbance = 0.0, rate = 0.0;
        for (std::size_t k = 0; k < steps.size(); ++k) {
            const Step& step = steps[k];
            const double before = disturbance;
            disturbance = step.f11 * before + step.f12 * rate, rate = step.f21 * before + step.f22 * rate;
            const double nu = step.root > 0.0 ? column[k] - offset - disturbance : 0.0;
            offset += step.gain[0] * nu, disturbance += step.gain[1] * nu, rate += step.gain[2] * nu;
            whitened[k] = step.root * nu;
        }
    }

  private:
    struct Step {
        double f11 = 1.0, f12 = 0.0, f21 = 0.0, f22 = 1.0;  // of the disturbance
        double gain[3] = {}, root = 0.0;                    // root: 1 / sqrt(S)
    };

    static void predict(double (&P)[3][3], const Step& f, double q11, double q12, double q22) {
        const double cross1 = P[0][1], cross2 = P[0][2], a = P[1][1], b = P[1][2], c = P[2][2];
        P[0][1] = P[1][0] = f.f11 * cross1 + f.f12 * cross2;
        P[0][2] = P[2][0] = f.f21 * cross1 + f.f22 * cross2;
        P[1][1] = f.f11 * f.f11 * a + 2.0 * f.f11 * f.f12 * b + f.f12 * f.f12 * c + q11;
        P[1][2] = P[2][1] = f.f11 * f.f21 * a + (f.f11 * f.f22 + f.f12 * f.f21) * b + f.f12 * f.f22 * c + q12;
        P[2][2] = f.f21 * f.f21 * a + 2.0 * f.f21 * f.f22 * b + f.f22 * f.f22 * c + q22;
    }

    std::vector<Step> steps;
};

// Where an axis goes without noise, relative to its start level, at n instants, with each of some dead times [ns]:
// those of one arm have its way through the commands in common. Each position follows from the last command.
// (delays, n).
inline void respond(const Arm<double>& arm, double start, const std::vector<Time>& delays, Time commands,
                    const Time* stamp, const double* command, Time n, const Time* time, double* position) {
    Response<double> response;
    response.start = start;
    if (commands > 0) response.time.ns = stamp[0];
    constexpr Time NEVER = std::numeric_limits<Time>::max();
    std::vector<Time> next(delays.size(), 0);
    Time due = -NEVER;  // the first instant of a position that is still asked for
    const auto ask = [&](Time until, bool commanded) {
        due = NEVER;
        for (std::size_t j = 0; j < delays.size(); ++j) {
            Time& k = next[j];
            for (; k < n && time[k] - delays[j] < until; ++k) {
                Response<double> then = response;
                const Instant<double> at{time[k] - delays[j], 0.0};
                if (commanded) arm.move_once(then.drive, then.slack, seconds(then.time, at));
                position[j * n + k] = then.position(arm);
            }
            if (k < n) due = std::min(due, time[k] - delays[j]);
        }
    };
    for (Time c = 0; c < commands; ++c) {
        if (due < stamp[c]) ask(stamp[c], c > 0);
        response.predict(arm, {stamp[c], 0.0});
        response.command(arm, command[c]);
    }
    ask(NEVER, commands > 0);
}

// Calls `work` with the first of each arms in a row that differ in their dead times alone, and with these [ns].
inline void by_delays(Time count, const pf_axis* axis, auto work) {
    const auto drop_delay = [](pf_axis shape) { return shape.delay = 0.0, shape; };
    for (Time i = 0, end = 0; i < count; i = end) {
        const pf_axis shape = drop_delay(axis[i]);
        std::vector<Time> delays;
        for (; end < count; ++end) {
            const pf_axis other = drop_delay(axis[end]);
            if (std::memcmp(&shape, &other, sizeof(shape)) != 0) break;
            delays.push_back(std::llround(axis[end].delay * 1e9));
        }
        work(i, delays);
    }
}

// The response at a gain of 1 and what each 1 of gain adds to it, whitened, times one another and times c columns that
// are, with each of some dead times: products (delays, 2, 2 + c).
inline void weigh(const pf_axis& axis, const std::vector<Time>& delays, const Whitening& whitening, Time commands,
                  const Time* stamp, const double* command, Time n, const Time* time, Time c, const double* whitened,
                  double* products) {
    const bool straight = axis.max_speed == 0.0 && axis.play == 0.0 && axis.sag_offset == 0.0 &&
                          axis.sag_slope == 0.0 && axis.sag_slope_beyond == 0.0 && axis.sag_slope_below == 0.0 &&
                          axis.slope == 0.0 && axis.recovery == 0.0;
    std::vector<double> raw[2], plain(n), more(n);
    for (int i = 0; i < (straight ? 1 : 2); ++i) {
        Axis<double> shape = lift<Axis, double>(&axis, 1, {})[0];
        shape.intercept = 1.0 + i;
        raw[i].resize(delays.size() * n);
        respond(Arm<double>(shape), axis.start, delays, commands, stamp, command, n, time, raw[i].data());
    }
    for (std::size_t d = 0; d < delays.size(); ++d, products += 2 * (2 + c)) {
        whitening(raw[0].data() + d * n, plain.data());
        if (straight) more = plain;
        else {
            whitening(raw[1].data() + d * n, more.data());
            for (Time k = 0; k < n; ++k) more[k] -= plain[k];
        }
        const double* columns[2] = {plain.data(), more.data()};
        for (int i = 0; i < 2; ++i)
            for (Time j = 0; j < 2 + c; ++j) {
                const double* other = j < 2 ? columns[j] : whitened + (j - 2) * n;
                double sum[4] = {};
                Time k = 0;
                for (; k + 4 <= n; k += 4)
                    for (int lane = 0; lane < 4; ++lane) sum[lane] += columns[i][k + lane] * other[k + lane];
                for (; k < n; ++k) sum[0] += columns[i][k] * other[k];
                products[i * (2 + c) + j] = (sum[0] + sum[1]) + (sum[2] + sum[3]);
            }
    }
}

}  // namespace pumafuse
