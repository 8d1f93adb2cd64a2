// What the C interface is made of: numbers with derivatives, sizes known to the compiler, errors as text.
#pragma once
#include <new>
#include <stdexcept>
#include <string>

#include "likelihood.hpp"

namespace pumafuse {

inline thread_local std::string error;  // of the last call of this thread that failed

template <int N>
struct Size {};

// Structs of numbers with derivatives, by as many tangents of the same type as there are.
template <template <class> class Of, class Real, class In>
std::vector<Of<Real>> lift(const In* in, Time count, const std::vector<const In*>& tangents) {
    constexpr std::size_t fields = sizeof(In) / sizeof(double);
    std::vector<Of<Real>> numbers(count);
    Real* to = reinterpret_cast<Real*>(numbers.data());
    for (std::size_t i = 0; i < count * fields; ++i) {
        to[i] = reinterpret_cast<const double*>(in)[i];
        if constexpr (!std::is_same_v<Real, double>)
            for (std::size_t k = 0; k < tangents.size(); ++k)
                to[i].d[k / 2][k % 2] = reinterpret_cast<const double*>(tangents[k])[i];
    }
    return numbers;
}

template <class Real>
Model<Real> model_of(const pf_model& model, const pf_model* tangents = nullptr, Time lanes = 0) {
    std::vector<const pf_axis*> axes;
    std::vector<const pf_sensor*> sensors;
    std::vector<const pf_view*> views;
    for (const pf_model* tangent = tangents; tangent < tangents + lanes; ++tangent)
        axes.push_back(tangent->axis), sensors.push_back(tangent->sensor), views.push_back(tangent->view);
    return {lift<Axis, Real>(model.axis, model.axes, axes),
            lift<Sensor, Real>(model.sensor, model.sensors, sensors),
            lift<View, Real>(model.view, model.sensors * model.axes, views)};
}

// Calls `make` with the compiled size for the states of the axis that has the most: the next larger one serves, and
// what is left over stays 0.
inline auto with_size(const pf_model& model, auto make) {
    int most = 0;
    for (const auto& axis : Filter<64>(model_of<double>(model)).axes) most = std::max(most, axis.noise.size);
    if (most <= 4) return make(Size<4>{});
    if (most <= 5) return make(Size<5>{});
    if (most <= 6) return make(Size<6>{});
    if (most <= 7) return make(Size<7>{});
    if (most <= 9) return make(Size<9>{});
    if (most <= 16) return make(Size<16>{});
    return make(Size<64>{});
}

// 0; -1 and an error text if the work cannot be done.
inline int attempt(auto work) {
    try {
        return work(), 0;
    } catch (const std::bad_alloc&) {
        error = "not enough memory";
    } catch (const std::exception& exception) {
        error = exception.what();
    }
    return -1;
}

}  // namespace pumafuse
