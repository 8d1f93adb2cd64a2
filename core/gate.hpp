// Which measurements are believed: the gate, and what lifts it.
//
// A measurement with |nu| > gate sqrt(S) is rejected. Outliers are independent, a wrong model persists: when two
// rejected measurements of one sensor, at least T apart and none fused between, agree with each other, the second is
// believed and nu^2 is added to the offset's variance (it re-acquires). But not where another sensor was fused on the
// same axis within the last 0.5 s and has not re-acquired more often: then one of the two is wrong, it cannot be known
// which, and what was believed goes on to be. Re-acquisitions are forgotten when all sensors of the axis agreed for 5
// s.
#pragma once
#include <cmath>

#include "model.hpp"

namespace pumafuse {

inline constexpr Time RECENT = 500'000'000;     // ns; a sensor fused within this time stands for what is believed
inline constexpr Time SETTLED = 5'000'000'000;  // ns; all sensors in agreement for so long: all is forgotten
inline constexpr int NOBODY = -1;
enum class Agreement { no, yes, too_soon };

// What is remembered of one sensor on one axis.
struct Gate {
    double nu = 0.0, R = 0.0;                             // of a rejected measurement that another may agree with
    Time rejected_at = PF_ALWAYS, fused_at = PF_ALWAYS;   // when that one, and the last that was fused, were valid
    std::int64_t in_a_row = 0, reacquired = 0;            // rejections in a row, and re-acquisitions

    void reject(double innovation, double noise, Time time, bool too_soon) {
        if (!too_soon || in_a_row == 0) nu = innovation, R = noise, rejected_at = time;
        ++in_a_row;
    }
};

// All sensors of one axis.
struct Gates {
    std::vector<Gate> sensor;     // (S,)
    Time unsettled = PF_ALWAYS;   // when sensors last disagreed while re-acquisitions were counted; else never

    // The sensor that stands for what is believed and contradicts `source`; NOBODY for none.
    int contradicted(int source, Time time) const {
        for (int other = 0; other < int(sensor.size()); ++other) {
            const Gate& gate = sensor[other];
            const bool recently = gate.fused_at > PF_ALWAYS && time - gate.fused_at <= RECENT;
            if (other != source && recently && gate.reacquired <= sensor[source].reacquired) return other;
        }
        return NOBODY;
    }

    void reject(int source, double nu, double R, Time time, bool too_soon) {
        sensor[source].reject(nu, R, time, too_soon);
        if (sensor[source].in_a_row > 1 && unsettled > PF_ALWAYS) unsettled = time;
    }

    void reacquire(int source, Time time) {
        ++sensor[source].reacquired;
        unsettled = time;
    }

    void fuse(int source, Time time) {
        sensor[source].in_a_row = 0, sensor[source].fused_at = time;
        if (unsettled == PF_ALWAYS || time - unsettled < SETTLED) return;
        for (const Gate& other : sensor)
            if (other.fused_at > PF_ALWAYS && time - other.fused_at > SETTLED) return;
        unsettled = PF_ALWAYS;
        for (Gate& other : sensor) other.reacquired = 0;
    }
};

// A difference of angles, less the whole turns in it; turn 0: as it is.
template <class Real>
Real nearest(Real difference, double turn) {
    return turn > 0.0 ? difference - turn * std::floor(value_of(difference) / turn + 0.5) : difference;
}

}  // namespace pumafuse
