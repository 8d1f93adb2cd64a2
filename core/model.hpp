// What the filter is told, in numbers that may carry derivatives: `Real` is double, or Dual (likelihood.hpp).
#pragma once
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <tuple>
#include <vector>

#include "pumafuse.h"

namespace pumafuse {

using Time = std::int64_t;  // ns
using Code = std::uint8_t;  // of PF_FUSED to PF_ABSENT

template <class Real>
struct Axis {  // the fields of pf_axis
    Real period, delay, time_constant, natural_frequency, damping, slope, intercept, recovery;
    Real max_speed, play, sag_offset, sag_slope, sag_knee, sag_slope_beyond, sag_knee_below, sag_slope_below;
    Real input_noise, drift, maneuver_noise, maneuver_drift, disturbance_sd, disturbance_time, smoothness;
    Real adaptation;
    Real offset_sd, lag_sd, gain_sd, unseen_lag_sd, start;
};

template <class Real>
struct Sensor { Real scale, latency, latency_sd, gate, gate_rows; };  // of pf_sensor

template <class Real>
struct View { Real sd, bias_sd, bias_drift_sd, bias_time, turn; };  // of pf_view

template <class Real>
struct Model {
    std::vector<Axis<Real>> axes;
    std::vector<Sensor<Real>> sensors;
    std::vector<View<Real>> views;  // (S, A)
};

template <int N, class Real>
using Vector = std::array<Real, N>;
template <int N, class Real>
using Matrix = std::array<std::array<Real, N>, N>;

inline double value_of(double a) { return a; }
inline bool is_zero(double a) { return a == 0.0; }
auto square(auto a) { return a * a; }

// An instant: its derivatives, if it has any, are those of the delay or the latency that it comes from.
template <class Real>
struct Instant {
    Time ns = 0;
    Real shift = 0.0;  // s; its value is 0
};

template <class Real>
Real seconds(const Instant<Real>& from, const Instant<Real>& to) {
    return double(to.ns - from.ns) / 1e9 + (to.shift - from.shift);
}

}  // namespace pumafuse
