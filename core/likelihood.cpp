// The likelihood's pass, with derivatives: apart, since here the compiler may join numbers to vectors (CMakeLists.txt).
#include "interface.hpp"

using namespace pumafuse;

namespace {

constexpr int LANES = 14;  // derivatives that one pass carries at most: as many as an axis of two sensors mostly has

// Calls `make` with as many lanes as k parameters need, where that is worth a compiler's time: few axes have many
// states.
template <int N>
void with_lanes(Time k, auto make) {
    if constexpr (N <= 7) {
        if (k <= 6) return make(std::integral_constant<int, 6>{});
        if (k <= 8) return make(std::integral_constant<int, 8>{});
        if (k <= 10) return make(std::integral_constant<int, 10>{});
        if (k <= 12) return make(std::integral_constant<int, 12>{});
    }
    make(std::integral_constant<int, LANES>{});
}

}  // namespace

int pf_linearise(const pf_model* model, const pf_model* tangents, int64_t k, int64_t origin, const pf_events* events,
                 const pf_results* results, double* d_innovation, double* d_variance) {
    const Time stride = events->count * model->axes;
    return attempt([&] {
        with_size(*model, [&]<int N>(Size<N>) {
            const Time passes = std::max((k + LANES - 1) / LANES, Time(1)), each = (k + passes - 1) / passes;
            for (Time first = 0, lanes; first < passes * each || first == 0; first += std::max(each, Time(1))) {
                lanes = std::min(k - first, each);
                with_lanes<N>(lanes, [&]<int L>(std::integral_constant<int, L>) {
                    const Filter<N, Dual<L>> filter(model_of<Dual<L>>(*model, tangents + first, lanes));
                    linearise(filter, {*events, results, model->axes}, origin, int(lanes),
                              d_innovation + first * stride, d_variance + first * stride);
                });
            }
        });
    });
}
