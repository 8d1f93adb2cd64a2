// The plain loop: the full recursion at every step, no frozen gain, dense matrices of fixed size.
//
// The covariance is of the leading M states: M = N is the dense filter, M = 2 leaves out the past commands, which have
// no variance. Where only the position is wanted, nothing else is written.
#include <cmath>
#include <thread>
#include <vector>

namespace {

constexpr int N = 5;
constexpr double TWO_PI = 6.283185307179586;

struct Model {
    double F[N][N], B[N], H[N], Q[N][N], R, P0[N][N];
};

template <int M>
struct State {
    double x[N] = {};
    double P[M][M];

    explicit State(const Model& m) {
        for (int i = 0; i < M; ++i)
            for (int j = 0; j < M; ++j) P[i][j] = m.P0[i][j];
    }

    /// Takes in z unless it is NaN; returns its log-likelihood, 0 when missing.
    double update(const Model& m, double z, double& v, double& S) {
        double PH[M];
        S = m.R;
        v = z;
        for (int i = 0; i < M; ++i) {
            PH[i] = 0.0;
            for (int j = 0; j < M; ++j) PH[i] += P[i][j] * m.H[j];
            S += m.H[i] * PH[i];
            v -= m.H[i] * x[i];
        }
        if (std::isnan(z)) return 0.0;
        const double inverse = 1.0 / S;
        for (int i = 0; i < M; ++i) {
            const double k = PH[i] * inverse;
            x[i] += k * v;
            for (int j = 0; j < M; ++j) P[i][j] -= k * PH[j];
        }
        return -0.5 * (std::log(TWO_PI * S) + v * v * inverse);
    }

    void predict(const Model& m, double u) {
        double next[N], FP[M][M];
        for (int i = 0; i < N; ++i) {
            next[i] = m.B[i] * u;
            for (int j = 0; j < N; ++j) next[i] += m.F[i][j] * x[j];
        }
        for (int i = 0; i < N; ++i) x[i] = next[i];
        for (int i = 0; i < M; ++i)
            for (int j = 0; j < M; ++j) {
                FP[i][j] = 0.0;
                for (int k = 0; k < M; ++k) FP[i][j] += m.F[i][k] * P[k][j];
            }
        for (int i = 0; i < M; ++i)
            for (int j = 0; j < M; ++j) {
                P[i][j] = m.Q[i][j];
                for (int k = 0; k < M; ++k) P[i][j] += FP[i][k] * m.F[j][k];
            }
    }
};

template <int M, bool ALL>
double filter_run(const Model& m, const double* u, const double* z, long steps, double* mean, double* cov,
                  double* innovation, double* variance) {
    State<M> s(m);
    double total = 0.0;
    for (long n = 0; n < steps; ++n) {
        total += s.update(m, z[n], innovation[n], variance[n]);
        if (ALL) {
            for (int i = 0; i < N; ++i) *mean++ = s.x[i];
            for (int i = 0; i < M; ++i)
                for (int j = 0; j < M; ++j) *cov++ = s.P[i][j];
        } else {
            *mean++ = s.x[0];
            *cov++ = s.P[0][0];
        }
        s.predict(m, u[n]);
    }
    return total;
}

template <int M>
double likelihood_run(const Model& m, const double* u, const double* z, long steps) {
    State<M> s(m);
    double total = 0.0, v, S;
    for (long n = 0; n < steps; ++n) {
        total += s.update(m, z[n], v, S);
        s.predict(m, u[n]);
    }
    return total;
}

/// Calls work(i) for all i < count, in equal shares per thread.
template <class Work>
void spread(long count, int threads, Work work) {
    auto share = [&](int t) {
        for (long i = count * t / threads; i < count * (t + 1) / threads; ++i) work(i);
    };
    std::vector<std::thread> others;
    for (int t = 1; t < threads; ++t) others.emplace_back(share, t);
    share(0);
    for (auto& other : others) other.join();
}

template <int M, bool ALL>
void filter(const Model* m, long runs, long steps, const double* u, const double* z, double* mean, double* cov,
            double* innovation, double* variance, double* log_likelihood, int threads) {
    spread(runs, threads, [=](long i) {
        const long at = i * steps;
        log_likelihood[i] = filter_run<M, ALL>(*m, u + at, z + at, steps, mean + at * (ALL ? N : 1),
                                               cov + at * (ALL ? M * M : 1), innovation + at, variance + at);
    });
}

}  // namespace

extern "C" {

void filter_dense(const Model* m, long runs, long steps, const double* u, const double* z, double* mean, double* cov,
                  double* innovation, double* variance, double* log_likelihood, int threads) {
    filter<N, true>(m, runs, steps, u, z, mean, cov, innovation, variance, log_likelihood, threads);
}

void filter_block(const Model* m, long runs, long steps, const double* u, const double* z, double* mean, double* cov,
                  double* innovation, double* variance, double* log_likelihood, int threads) {
    filter<2, true>(m, runs, steps, u, z, mean, cov, innovation, variance, log_likelihood, threads);
}

void filter_position(const Model* m, long runs, long steps, const double* u, const double* z, double* mean, double* cov,
                     double* innovation, double* variance, double* log_likelihood, int threads) {
    filter<2, false>(m, runs, steps, u, z, mean, cov, innovation, variance, log_likelihood, threads);
}

void likelihood_dense(const Model* models, long count, long steps, const double* u, const double* z,
                      double* log_likelihood, int threads) {
    spread(count, threads, [=](long i) { log_likelihood[i] = likelihood_run<N>(models[i], u, z, steps); });
}

void likelihood_block(const Model* models, long count, long steps, const double* u, const double* z,
                      double* log_likelihood, int threads) {
    spread(count, threads, [=](long i) { log_likelihood[i] = likelihood_run<2>(models[i], u, z, steps); });
}

/// Bryson-Frazier: nothing but the innovation's variance is inverted, so states without variance do no harm.
void smooth_dense(const Model* model, long steps, const double* u, const double* z, double* mean, double* cov) {
    const Model& m = *model;
    std::vector<State<N>> predicted;
    predicted.reserve(steps);
    std::vector<double> innovation(steps), variance(steps);
    State<N> s(m);
    for (long n = 0; n < steps; ++n) {
        predicted.push_back(s);
        s.update(m, z[n], innovation[n], variance[n]);
        s.predict(m, u[n]);
    }

    double r[N] = {}, L[N][N] = {};
    for (long n = steps - 1; n >= 0; --n) {
        const State<N>& p = predicted[n];
        double t[N], LF[N][N], A[N][N];
        for (int i = 0; i < N; ++i) {
            t[i] = 0.0;
            for (int j = 0; j < N; ++j) t[i] += m.F[j][i] * r[j];
        }
        for (int i = 0; i < N; ++i)
            for (int j = 0; j < N; ++j) {
                LF[i][j] = 0.0;
                for (int k = 0; k < N; ++k) LF[i][j] += L[i][k] * m.F[k][j];
            }
        for (int i = 0; i < N; ++i)
            for (int j = 0; j < N; ++j) {
                A[i][j] = 0.0;
                for (int k = 0; k < N; ++k) A[i][j] += m.F[k][i] * LF[k][j];
            }
        if (!std::isnan(z[n])) {
            const double inverse = 1.0 / variance[n];
            double gain[N], Ag[N], gt = 0.0, gAg = 0.0;
            for (int i = 0; i < N; ++i) {
                gain[i] = 0.0;
                for (int j = 0; j < N; ++j) gain[i] += p.P[i][j] * m.H[j] * inverse;
            }
            for (int i = 0; i < N; ++i) {
                Ag[i] = 0.0;
                for (int j = 0; j < N; ++j) Ag[i] += A[i][j] * gain[j];
                gt += gain[i] * t[i];
                gAg += gain[i] * Ag[i];
            }
            for (int i = 0; i < N; ++i) {
                t[i] += m.H[i] * (innovation[n] * inverse - gt);
                for (int j = 0; j < N; ++j)
                    A[i][j] += m.H[i] * m.H[j] * (gAg + inverse) - Ag[i] * m.H[j] - m.H[i] * Ag[j];
            }
        }
        double PA[N][N];
        for (int i = 0; i < N; ++i) {
            r[i] = t[i];
            mean[n * N + i] = p.x[i];
            for (int j = 0; j < N; ++j) {
                L[i][j] = A[i][j];
                mean[n * N + i] += p.P[i][j] * t[j];
                PA[i][j] = 0.0;
                for (int k = 0; k < N; ++k) PA[i][j] += p.P[i][k] * A[k][j];
            }
        }
        for (int i = 0; i < N; ++i)
            for (int j = 0; j < N; ++j) {
                double removed = 0.0;
                for (int k = 0; k < N; ++k) removed += PA[i][k] * p.P[k][j];
                cov[(n * N + i) * N + j] = p.P[i][j] - removed;
            }
    }
}
}
