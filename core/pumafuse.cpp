// The C interface (pumafuse.h): from flat arrays to filters whose number of states is known to the compiler.
#include <memory>
#include <variant>

#include "interface.hpp"
#include "smoother.hpp"
#include "window.hpp"

using namespace pumafuse;

namespace {

// A type for each size that is compiled.
template <template <int> class Of>
using Sized = std::variant<Of<4>, Of<6>, Of<9>, Of<16>, Of<64>>;

template <int N>
struct Recorded {
    Filter<N> filter;
    State<N, double> state;
};

template <int N>
using Stream = std::unique_ptr<Window<N>>;

}  // namespace

struct pf_filter {
    Time axes;
    Sized<Recorded> core;
};

struct pf_live {
    Sized<Stream> core;
};

int pf_version(void) { return PF_VERSION; }

const char* pf_error(void) { return error.c_str(); }

void pf_transition(const pf_axis* axis, double dt, double step[17]) {
    const Arm<double> arm(lifted<Axis, double>(axis, 1, {})[0]);
    const Transition<double> f = arm.plant.over(dt);
    const double lambda = std::sqrt(3.0) / axis->disturbance_time, density = 4.0 / lambda;
    const Transition<double> d = Plant<double>(lambda, 1.0, 0.0).over(dt);
    const double found[] = {f.f11, f.f12, f.f21, f.f22, f.q11, f.q12, f.q22, f.e1, f.e2, f.left, d.f11, d.f12, d.f21,
                            d.f22, density * d.q11, density * d.q12, density * d.q22};
    std::copy_n(found, 17, step);
}

void pf_response(const pf_axis* axis, int64_t commands, const int64_t* acts, const double* command, int64_t n,
                 const int64_t* time, double* position) {
    const Arm<double> arm(lifted<Axis, double>(axis, 1, {})[0]);
    Response<double> response;
    response.start = axis->start;
    if (commands > 0 && n > 0) response.time.ns = std::min(acts[0], time[0]);
    for (int64_t k = 0, c = 0; k < n; ++k) {
        for (; c < commands && acts[c] <= time[k]; ++c) {
            response.predict(arm.plant, {acts[c], 0.0});
            response.command(arm, command[c]);
        }
        response.predict(arm.plant, {time[k], 0.0});
        position[k] = response.x;
    }
}

void pf_classify(const pf_model* model, const pf_events* events, int64_t origin, const uint8_t* too_late,
                 uint8_t* known) {
    const Table rows{*events, nullptr, model->axes};
    for (Time row = 0; row < events->count; ++row) {
        const bool again = events->source[row] != PF_COMMAND && repeats_earlier(rows, row, 0, int(model->axes));
        const Code whole = again ? PF_DUPLICATE : too_late[row] ? PF_TOO_LATE : PF_FUSED;
        for (int a = 0; a < model->axes; ++a)
            known[row * model->axes + a] =
                Policy{*model, origin}.classify(rows, row, a, 0, events->count, whole, model->axis[a].start);
    }
}

pf_filter* pf_filter_new(const pf_model* model, int64_t origin) {
    pf_filter* made = nullptr;
    attempt([&] {
        sized(*model, [&]<int N>(Size<N>) {
            Filter<N> filter(model_of<double>(*model));
            made = new pf_filter{model->axes, Recorded<N>{filter, filter.at_rest(origin)}};
        });
    });
    return made;
}

void pf_filter_free(pf_filter* filter) { delete filter; }

void pf_filter_run(pf_filter* filter, const pf_events* events, int64_t begin, int64_t end, int given,
                   const pf_results* results, int64_t n, const int64_t* time, double* outputs) {
    const Table rows{*events, results, filter->axes};
    std::visit([&](auto& core) { run(core.filter, core.state, rows, begin, end, given, n, time, outputs); },
               filter->core);
}

int pf_filter_run_as_live(pf_filter* filter, const pf_events* events, const pf_results* results, int64_t n,
                          const int64_t* time, double* outputs) {
    const Table rows{*events, results, filter->axes};
    const auto work = [&](auto& core) { run_as_live(core.filter, core.state, rows, n, time, outputs); };
    return attempt([&] { std::visit(work, filter->core); });
}

int pf_filter_smooth(pf_filter* filter, const pf_events* events, const pf_results* results, int64_t n,
                     const int64_t* time, double* outputs) {
    const Table rows{*events, results, filter->axes};
    const auto work = [&](auto& core) { run_smoothed(core.filter, core.state, rows, n, time, outputs); };
    return attempt([&] { std::visit(work, filter->core); });
}

int pf_filter_bias(const pf_filter* filter, int64_t sensor, int64_t axis, double bias[2]) {
    return std::visit([&](const auto& core) {
        const int i = core.filter.bias[sensor * filter->axes + axis];
        const auto& xi = core.state.axes[axis].residual;
        if (i >= 0) bias[0] = xi.x[i], bias[1] = std::sqrt(std::max(xi.P[i][i], 0.0));
        return int(i >= 0);
    }, filter->core);
}

void pf_constant_velocity(int64_t n, const double* time, const double* value, int64_t g, const double* density,
                          double* square, double* innovation) {
    constexpr double UNKNOWN = 1e6;  // variance of the rate at first
    for (int64_t k = 0; k < g; ++k) {
        double position = value[0], rate = 0.0, p11 = 1.0, p12 = 0.0, p22 = UNKNOWN;
        for (int64_t i = 1; i < n; ++i) {
            const double dt = time[i] - time[i - 1], noise = density[k] * dt;
            const double a = p11 + dt * (2.0 * p12 + dt * (p22 + noise / 3.0)), b = p12 + dt * (p22 + 0.5 * noise);
            const double gain = a / (a + 1.0), rate_gain = b / (a + 1.0), predicted = position + rate * dt;
            const double nu = value[i] - predicted;
            square[k] += nu * nu, position = predicted + gain * nu, rate += rate_gain * nu;
            p11 = gain, p12 = rate_gain, p22 += noise - rate_gain * b;
            if (innovation && k == g - 1) innovation[i - 1] = nu;
        }
    }
}

pf_live* pf_live_new(const pf_model* model, int64_t room, int64_t most, const pf_counters* carried) {
    pf_live* made = nullptr;
    attempt([&] {
        if (model->axes > 62) throw std::length_error("a stream is followed on at most 62 axes");
        Counters counters(model->sensors);
        if (carried) counters.carry(*carried);
        sized(*model, [&]<int N>(Size<N>) {
            made = new pf_live{std::make_unique<Window<N>>(*model, model_of<double>(*model), room, most, counters)};
        });
    });
    return made;
}

void pf_live_free(pf_live* live) { delete live; }

pf_port* pf_live_port(pf_live* live) {
    return std::visit([](auto& window) { return &window->port; }, live->core);
}

int pf_live_measurement(pf_live* live, int64_t stamp, int64_t sensor, uint64_t given, int64_t newest, int64_t oldest) {
    int taken = 0;
    const auto work = [&](auto& one) { taken = one->measurement(stamp, int(sensor), given, newest, oldest); };
    return attempt([&] { std::visit(work, live->core); }) < 0 ? -1 : taken;
}

int pf_live_command(pf_live* live, int64_t stamp, uint64_t given, int64_t oldest) {
    int taken = 0;
    const auto work = [&](auto& window) { taken = window->command(stamp, given, oldest); };
    return attempt([&] { std::visit(work, live->core); }) < 0 ? -1 : taken;
}

void pf_live_estimate(pf_live* live, int64_t time, int64_t after, double* outputs, int64_t* fused) {
    std::visit([&](auto& window) { window->estimate(time, after, outputs, fused); }, live->core);
}

void pf_live_commands(const pf_live* live, int64_t until, int64_t* stamp, double* value, double* step) {
    std::visit([&](const auto& window) { window->commands(until, stamp, value, step); }, live->core);
}

int pf_live_forget(pf_live* live, int64_t after) {
    return attempt([&] { std::visit([&](auto& window) { window->forget(after); }, live->core); });
}

void pf_live_count_late(pf_live* live, int64_t sensor, int64_t stamp, int64_t newest, int64_t times) {
    std::visit([&](auto& window) { window->count_late(int(sensor), stamp, newest, times); }, live->core);
}

int pf_live_counters(const pf_live* live, const pf_counters* found) {
    return attempt([&] { std::visit([&](const auto& window) { window->counted().give(*found); }, live->core); });
}
