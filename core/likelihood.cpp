// The likelihood's pass, with derivatives: apart, since here the compiler may join numbers to vectors (CMakeLists.txt).
#include "interface.hpp"

using namespace pumafuse;

int pf_linearise(const pf_model* model, const pf_model* tangents, int64_t k, int64_t origin, const pf_events* events,
                 const pf_results* results, double* d_innovation, double* d_variance) {
    const Time stride = events->count * model->axes;
    return attempt([&] {
        sized(*model, [&]<int N>(Size<N>) {
            for (Time first = 0; first < std::max(k, Time(1)); first += LANES) {
                const Time lanes = std::min(k - first, Time(LANES));
                const Filter<N, Dual> filter(model_of<Dual>(*model, tangents + first, lanes));
                linearise(filter, {*events, results, model->axes}, origin, int(lanes), d_innovation + first * stride,
                          d_variance + first * stride);
            }
        });
    });
}
