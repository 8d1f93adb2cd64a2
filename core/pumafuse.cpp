// The C interface (pumafuse.h): from flat arrays to filters whose number of states is known to the compiler.
#include "interface.hpp"
#include "search.hpp"
#include "smoother.hpp"
#include "window.hpp"

using namespace pumafuse;

struct pf_filter {
    Time axes;

    explicit pf_filter(Time axes) : axes(axes) {}
    virtual ~pf_filter() = default;
    virtual void run(int mode, const Table& rows, Time begin, Time end, Time n, const Time* time, const Time* asked,
                     double* outputs) = 0;
    virtual bool bias(Time sensor, Time axis, double numbers[2]) const = 0;
};

namespace {

template <int N>
struct Recorded final : pf_filter {
    Filter<N> filter;
    State<N, double> state;

    Recorded(const pf_model& model, Time origin)
        : pf_filter(model.axes), filter(model_of<double>(model)), state(filter.at_rest(origin)) {}

    void run(int mode, const Table& rows, Time begin, Time end, Time n, const Time* time, const Time* asked,
             double* outputs) override {
        if (mode == PF_AS_LIVE) run_as_live(filter, state, rows, n, time, asked ? asked : time, outputs);
        else if (mode == PF_SMOOTHED) run_smoothed(filter, state, rows, n, time, outputs);
        else pumafuse::run(filter, state, rows, begin, end, mode == PF_REPEATED, n, time, outputs);
    }

    bool bias(Time sensor, Time axis, double numbers[2]) const override {
        const int i = filter.bias[sensor * axes + axis];
        const Residual<N, double>& xi = state.axes[axis].residual;
        if (i >= 0) numbers[0] = xi.x[i], numbers[1] = filter.axes[axis].sd_of(xi, i);
        return i >= 0;
    }
};

}  // namespace

int pf_version(void) { return PF_VERSION; }

const char* pf_error(void) { return error.c_str(); }

void pf_transition(const pf_axis* axis, double dt, double step[17]) {
    const Arm<double> arm(lift<Axis, double>(axis, 1, {})[0]);
    const Driven<double>& f = arm.plant.driven_over(dt);
    const Decay<double> e = arm.plant.decaying(f, dt);
    const double lambda = std::sqrt(3.0) / axis->disturbance_time, density = 4.0 / lambda;
    const Driven<double> d = Plant<double>(lambda, 1.0, 0.0).driven_over(dt);
    const double numbers[] = {f.f11, f.f12, f.f21, f.f22, f.q11, f.q12, f.q22, e.position, e.rate, e.left, d.f11, d.f12,
                              d.f21, d.f22, density * d.q11, density * d.q12, density * d.q22};
    std::copy_n(numbers, 17, step);
}

int pf_response(int64_t count, const pf_axis* axis, int64_t commands, const int64_t* stamp, const double* command,
                int64_t n, const int64_t* time, double* position) {
    return attempt([&] {
        by_delays(count, axis, [&](Time i, const std::vector<Time>& delays) {
            const Arm<double> arm(lift<Axis, double>(axis + i, 1, {})[0]);
            respond(arm, axis[i].start, delays, commands, stamp, command, n, time, position + i * n);
        });
    });
}

void pf_follow(const pf_axis* axis, pf_motion* motion, int64_t commands, const int64_t* stamp, const double* command,
               int64_t n, const int64_t* time, double* position) {
    const Arm<double> arm(lift<Axis, double>(axis, 1, {})[0]);
    const Drive<double> drive{motion->command, motion->error, motion->position, motion->rate};
    Response<double> response{{motion->time}, axis->start, motion->step, drive, motion->slack};
    follow(response, arm, std::llround(axis->delay * 1e9), commands, stamp, command, n, time, position);
    const auto& [u, e, x, rate] = response.drive;
    *motion = {response.time.ns, u, response.step, e, x, rate, response.slack};
}

int pf_whiten(const pf_noise* noise, int64_t n, const int64_t* time, const double* variance, int64_t c,
              const double* columns, double* whitened, double* log_determinant) {
    return attempt([&] {
        const Whitening whitening(*noise, n, time, variance);
        for (int64_t j = 0; j < c; ++j) whitening(columns + j * n, whitened + j * n);
        *log_determinant = whitening.log_determinant;
    });
}

int pf_weigh(const pf_noise* noise, int64_t n, const int64_t* time, const double* variance, int64_t c,
             const double* whitened, int64_t commands, const int64_t* stamp, const double* command, int64_t count,
             const pf_axis* axis, double* products) {
    return attempt([&] {
        const Whitening whitening(*noise, n, time, variance);
        by_delays(count, axis, [&](Time i, const std::vector<Time>& delays) {
            weigh(axis[i], delays, whitening, commands, stamp, command, n, time, c, whitened,
                  products + i * 2 * (2 + c));
        });
    });
}

int pf_classify(const pf_model* model, const pf_events* events, int64_t origin, const uint8_t* too_late,
                uint8_t* known) {
    return attempt([&] {
        const Table rows{*events, nullptr, model->axes};
        const Policy policy{model_of<double>(*model), origin};
        for (Time row = 0; row < events->count; ++row) {
            const bool again = events->source[row] != PF_COMMAND && repeats_earlier(rows, row, 0, int(model->axes));
            const Code whole = again ? PF_DUPLICATE : too_late[row] ? PF_TOO_LATE : PF_FUSED;
            for (int a = 0; a < model->axes; ++a)
                known[row * model->axes + a] =
                    policy.classify(rows, row, a, 0, events->count, whole, model->axis[a].start);
        }
    });
}

pf_filter* pf_filter_new(const pf_model* model, int64_t origin) {
    pf_filter* made = nullptr;
    attempt([&] { with_size(*model, [&]<int N>(Size<N>) { made = new Recorded<N>(*model, origin); }); });
    return made;
}

void pf_filter_free(pf_filter* filter) { delete filter; }

int pf_filter_run(pf_filter* filter, int mode, const pf_events* events, int64_t begin, int64_t end,
                  const pf_results* results, int64_t n, const int64_t* time, const int64_t* asked, double* outputs) {
    const Table rows{*events, results, filter->axes};
    return attempt([&] { filter->run(mode, rows, begin, end, n, time, asked, outputs); });
}

int pf_filter_bias(const pf_filter* filter, int64_t sensor, int64_t axis, double bias[2]) {
    return filter->bias(sensor, axis, bias);
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

pf_live* pf_live_new(const pf_model* model, int64_t room, int64_t most) {
    pf_live* made = nullptr;
    attempt([&] {
        if (model->axes > 62) throw std::length_error("a stream is followed on at most 62 axes");
        with_size(*model, [&]<int N>(Size<N>) { made = new Window<N>(model_of<double>(*model), room, most); });
    });
    return made;
}

void pf_live_free(pf_live* live) { delete live; }

pf_port* pf_live_port(pf_live* live) { return &live->port; }

int pf_live_add(pf_live* live, int64_t stamp, int64_t source, uint64_t bits, int64_t oldest) {
    int taken = 0;
    return attempt([&] { taken = live->add(stamp, int(source), bits, oldest); }) < 0 ? -1 : taken;
}

void pf_live_estimate(pf_live* live, int64_t time, int64_t after, double* outputs, int64_t* fused) {
    live->estimate(time, after, outputs, fused);
}

void pf_live_read(const pf_live* live, int64_t begin, int64_t end, int64_t* stamp, int16_t* source,
                  const pf_results* results) {
    live->read(begin, end, stamp, source, *results);
}

void pf_live_forget(pf_live* live, int64_t after) { live->forget(after); }

void pf_live_amend(pf_live* live, int64_t sensor, int64_t n, const int64_t* stamp, const double* before,
                   const double* now) {
    live->amend(int(sensor), n, stamp, before, now);
}
