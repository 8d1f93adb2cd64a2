/* pumafuse.h: the filter of pumafuse in C. One library, no dependency.
 *
 * All numbers are SI: m, m/s and s; of an axis that is an angle rad and rad/s. Instants are int64 nanoseconds of any
 * one clock. Matrices are flat, the last index runs fastest: "(S, A)" is S rows of A numbers.
 * Ownership: what a caller gives is read, and what it gets is written, during the call alone; nothing of it is kept or
 * freed. Who makes a pf_filter or a pf_live frees it.
 * Errors: a call that may fail returns NULL or a number below 0; pf_error() then has one line on why.
 * Threads: a pf_filter or a pf_live belongs to one thread at a time; different ones do not know of each other.
 * Not checked: that counts, the numbers of sensors and axes, and the order of events are as said here. */
#ifndef PUMAFUSE_H
#define PUMAFUSE_H

#include <stdint.h>

#if defined(_WIN32)
#define PF_API __declspec(dllexport)
#else
#define PF_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define PF_VERSION 13             /* of this interface: a program and its library must agree */
#define PF_NO_STAMP INT64_MIN     /* the time of a row without a readable stamp */
#define PF_ALWAYS (INT64_MIN + 1) /* before all instants */
#define PF_NEVER INT64_MAX        /* after all instants */
#define PF_COMMAND (-1)           /* the source of a command */
#define PF_FINEST 1e-9            /* [m or rad]: no position is known better, of a velocity over a period */

/* What became of a value; PF_ABSENT: the row gives none for this axis. */
enum {
    PF_FUSED, PF_REJECTED, PF_REACQUIRED, PF_DUPLICATE, PF_BEFORE_START, PF_TOO_LATE, PF_INVALID, PF_UNKNOWN,
    PF_STRAY, PF_HELD, /* before it comes to the core: a command that nobody sent, a value that is no news */
    PF_ABSENT = 255
};

/* What an estimate says of an axis, relative to its start level: first index of outputs (PF_OUTPUTS, A, n). */
enum {
    PF_POSITION, PF_POSITION_SD,       /* p [m] */
    PF_VELOCITY, PF_VELOCITY_SD,       /* mean over the coming period [m/s]; NaN where smoothed */
    PF_OFFSET, PF_OFFSET_SD,           /* o [m] */
    PF_DISTURBANCE, PF_DISTURBANCE_SD, /* d [m]; 0 where the axis has none */
    PF_OUTPUTS
};

/* How an axis answers its commands, and what it does that nobody commanded. */
typedef struct {
    double period, delay;                  /* T and Td [s]: from a command to the next, and to where it acts */
    double time_constant;                  /* tau [s] of a first-order plant; 0: it is of second order */
    double natural_frequency, damping;     /* omega [rad/s] and zeta */
    double slope, intercept;               /* a [s/m] and b of the gain K = a * speed + b */
    double recovery;                       /* Tr [s], of the gain error; 0: it stays */
    double max_speed;                      /* V [m/s], the fastest that the drive goes; 0: as fast as it is asked to */
    double play;                           /* between drive and tool [m] */
    double sag_offset, sag_slope;          /* where the tool hangs at a level p as logged: offset + slope p [m, 1] */
    double sag_knee, sag_slope_beyond;     /* level [m] above which the slope is this one */
    double sag_knee_below, sag_slope_below; /* level [m] below which the slope is this one */
    double input_noise, drift;             /* densities: white noise on the input [m/sqrt(Hz)]; offset [m/sqrt(s)] */
    double maneuver_noise, maneuver_drift; /* what each m/s of maneuver adds to them, likewise */
    double disturbance_sd, disturbance_time; /* [m], 0: there is none; [s] */
    double smoothness;                     /* of the disturbance: 1.5 (Matern) or 0.5 (Ornstein-Uhlenbeck) */
    double adaptation;                     /* how fast all these follow what innovations show; 0: they stay */
    double offset_sd;                      /* prior of the offset [m] */
    double lag_sd, gain_sd;                /* how well the response is known: its lag [s], its size, of 1 */
    double unseen_lag_sd;                  /* likewise its lag [s] where no measurement tells: between those in step */
    double start;                          /* u0 [m]: where it rests before its first command; NaN: not known */
} pf_axis;

/* A sensor: z = scale * p(stamp - latency) + biases + noise. */
typedef struct {
    double scale;
    double latency, latency_sd; /* [s]; the sd is how far it wanders */
    double gate;                /* [standard deviations]; 0: none */
    double gate_rows;           /* 1: one axis beyond the gate rejects its row; 0: itself alone */
} pf_sensor;

/* What a sensor sees of an axis. */
typedef struct {
    double sd;                       /* noise [m]; NaN: the sensor is not used there */
    double bias_sd, bias_drift_sd;   /* of a constant bias, and of one that drifts [m]; 0: none is in the state */
    double bias_time;                /* how long such a drift lasts [s] */
    double turn;                     /* angle after which it measures the same again [rad]; 0: never */
} pf_view;

typedef struct {
    int64_t axes, sensors;
    const pf_axis *axis;     /* (A,) */
    const pf_sensor *sensor; /* (S,), in the order in which they count at one instant */
    const pf_view *view;     /* (S, A) */
} pf_model;

/* n events by time; at one instant commands first, then the sensors in their order, then by stamp. */
typedef struct {
    int64_t count;
    const int64_t *time;   /* when a command acts, or a measurement is valid, (n,) */
    const int16_t *source; /* PF_COMMAND or which sensor, (n,) */
    const int64_t *stamp;  /* as logged, (n,) */
    const double *value;   /* [m] as logged, (n, A) */
    const double *spread;  /* by what the noise of each is scaled, (n, A); NULL: by nothing */
    const uint8_t *known;  /* PF_FUSED where the filter decides, else what the value is, (n, A) */
    const int64_t *arrival; /* when it came, (n,); NULL: at its stamp */
} pf_events;

/* What became of n events; the caller's arrays. Values that the filter does not decide on are not written. */
typedef struct {
    double *innovation, *innovation_sd; /* nu and sqrt(S) [m], (n, A) */
    double *noise_scale; /* how many times as large as configured the arm's variances were, (n, A) */
    uint8_t *outcome;    /* (n, A) */
    int16_t *contradicts; /* the sensor that a rejected row contradicts time after time, -1: none, (n,) */
} pf_results;

PF_API int pf_version(void);
PF_API const char *pf_error(void); /* of the last call of this thread that failed */

/* What an axis does over dt [s]. step: Phi11, Phi12, Phi21, Phi22, Q11, Q12, Q22 of its plant for unit noise on the
 * input; what an input that decays from 1 m by exp(-dt/Tr) makes of position and rate, and what is left of it; Phi and
 * Q of a smooth disturbance of variance 1. */
PF_API void pf_transition(const pf_axis *axis, double dt, double step[17]);
/* Where each of `count` arms goes without noise, relative to its start level [m], at n instants, ascending; commands
 * [m] come at their instants, ascending. position (count, n). Returns 0; -1 without memory, as the next ones do. */
PF_API int pf_response(int64_t count, const pf_axis *axis, int64_t commands, const int64_t *stamp,
                       const double *command, int64_t n, const int64_t *time, double *position);

/* What an axis without noise does just after a command, relative to its start level: when it acts [ns], the command in
 * force and the step that it was [m], the gain error [m], position [m] and rate [m/s] of the drive, and what the tool
 * is ahead of it [m]. At rest before any: PF_ALWAYS and zeros. */
typedef struct {
    int64_t time;
    double command, step, error, position, rate, slack;
} pf_motion;

/* The same as pf_response from a motion on, which becomes that after the commands. Each position follows from the last
 * command alone: it is the same whatever else is asked for, and in whatever pieces. */
PF_API void pf_follow(const pf_axis *axis, pf_motion *motion, int64_t commands, const int64_t *stamp,
                      const double *command, int64_t n, const int64_t *time, double *position);

/* What an arm leaves of what is measured, beside white noise. */
typedef struct {
    double walk, offset_sd;                  /* of a random walk: density [m/sqrt(s)], and where it begins [m] */
    double disturbance_sd, disturbance_time; /* [m], 0: there is none; [s] */
    double smoothness;                       /* of the disturbance, as in pf_axis */
} pf_noise;

/* c columns (c, n) of what was measured at n instants, ascending, with white noise of `variance` (n,) [m^2], infinite
 * where none was: their innovations over standard deviations, and the sum of log S. */
PF_API int pf_whiten(const pf_noise *noise, int64_t n, const int64_t *time, const double *variance, int64_t c,
                     const double *columns, double *whitened, double *log_determinant);
/* How `count` arms fit c columns that are whitened: the scalar products of two whitened responses, that to a gain of 1
 * and what 1 of gain adds to it, with each other and with the columns. products (count, 2, 2 + c). */
PF_API int pf_weigh(const pf_noise *noise, int64_t n, const int64_t *time, const double *variance, int64_t c,
                    const double *whitened, int64_t commands, const int64_t *stamp, const double *command,
                    int64_t count, const pf_axis *axis, double *products);
/* What each value is before the filter sees it, into known (n, A); too_late (n,): rows far behind earlier ones. */
PF_API int pf_classify(const pf_model *model, const pf_events *events, int64_t origin, const uint8_t *too_late,
                       uint8_t *known);

/* A filter over recorded events; its state goes on from call to call. It begins at rest at the instant `origin`. */
typedef struct pf_filter pf_filter;
PF_API pf_filter *pf_filter_new(const pf_model *model, int64_t origin);
PF_API void pf_filter_free(pf_filter *filter); /* NULL: nothing */
/* How estimates are asked for: by the events until then; likewise, where outcomes are repeated, whatever a gate would
 * say; by the events that had arrived by then, or by when each estimate is `asked` for; by all measurements. */
enum { PF_FILTERED, PF_REPEATED, PF_AS_LIVE, PF_SMOOTHED };
/* Events begin to end, all of them for the last two, and an estimate at each of n times, ascending; the commands in
 * later rows that are stamped and have arrived by then are known, too. asked (n,), or NULL: at these times. outputs
 * (PF_OUTPUTS, A, n). Returns 0; -1 without memory. */
PF_API int pf_filter_run(pf_filter *filter, int mode, const pf_events *events, int64_t begin, int64_t end,
                         const pf_results *results, int64_t n, const int64_t *time, const int64_t *asked,
                         double *outputs);
/* Mean and sd [m] of the constant bias of a sensor on an axis; returns 1, or 0 where none is in the state. */
PF_API int pf_filter_bias(const pf_filter *filter, int64_t sensor, int64_t axis, double bias[2]);

/* The likelihood's pass: what a run of all events gives while outcomes are repeated, and how it changes with k
 * parameters. tangents are d(model)/d(parameter), k models of the same size; the derivatives of innovation and S go to
 * d_innovation and d_variance (k, n, A). Returns 0; -1 without memory. */
PF_API int pf_linearise(const pf_model *model, const pf_model *tangents, int64_t k, int64_t origin,
                        const pf_events *events, const pf_results *results, double *d_innovation, double *d_variance);

/* The simplest rival: constant-velocity filters with R = 1 on n measurements at times [any unit], ascending, g
 * densities of the noise on their acceleration. Adds the squares of the innovations to square (g,); those of the last
 * filter go to innovation (n - 1,), unless that is NULL. */
PF_API void pf_constant_velocity(int64_t n, const double *time, const double *value, int64_t g, const double *density,
                                 double *square, double *innovation);

/* A filter that is fed event by event, in any order of arrival: the last seconds stay, with a checkpoint before each
 * event, and what comes late is put in its place. */
typedef struct pf_live pf_live;

/* What goes in and comes out of a pf_live, in its memory; A <= 62. */
typedef struct {
    double *value, *spread; /* of the event that comes in [m], and by what its noise is scaled, else 1, (A,) */
    uint8_t *outcome;       /* what became of each, PF_ABSENT for an axis that the event does not give, (A,) */
    double *innovation, *innovation_sd; /* of each value of a measurement [m], (A,) */
    int64_t contradicts;    /* the sensor that the last measurement contradicts time after time; -1: none */
    int64_t origin;         /* stamp of the first command; PF_NEVER before it */
    int64_t floor;          /* what is stamped before is taken no more: the stream was too dense; PF_ALWAYS at first */
    int64_t room;           /* rows that there is room for; one for an event, of a command for each delay of its axes */
    int64_t begin, end;     /* the rows of the window, counted from the first that ever came */
} pf_port;

/* Empty. room: events that it has memory for at first, most: at the most; with both alike nothing allocates later.
 * Returns NULL on failure. */
PF_API pf_live *pf_live_new(const pf_model *model, int64_t room, int64_t most);
PF_API void pf_live_free(pf_live *live); /* NULL: nothing */
PF_API pf_port *pf_live_port(pf_live *live); /* the same all its life */
/* Take in the event in the port, of a sensor or PF_COMMAND, of the axes in `bits`: bit a is axis a. No event that is
 * stamped before `oldest` will come any more. Returns 1; 0 if to make room the window let go of its time; -1 without
 * memory. */
PF_API int pf_live_add(pf_live *live, int64_t stamp, int64_t source, uint64_t bits, int64_t oldest);
/* Every axis at an instant by all measurements valid until then, of events that are stamped until `after` (PF_NEVER: by
 * all); nothing changes. outputs (PF_OUTPUTS, A): positions as logged, NaN for an axis of which no level is known;
 * fused (A,): when the last measurement was valid that it knows of. */
PF_API void pf_live_estimate(pf_live *live, int64_t time, int64_t after, double *outputs, int64_t *fused);
/* What became of rows begin to end: their stamp, source (n,), and results (n, A), which mean nothing for a command.
 * Those before port->begin do not change any more. They are there to be read until room / 16 more have come. */
PF_API void pf_live_read(const pf_live *live, int64_t begin, int64_t end, int64_t *stamp, int16_t *source,
                         const pf_results *results);
/* Take back all that is stamped after an instant: it was of another clock. */
PF_API void pf_live_forget(pf_live *live, int64_t after);
/* Measurements of a sensor that are known better now: of n rows by their stamps (n,) the values and spreads (n, 2 A),
 * where the values are as they were before. */
PF_API void pf_live_amend(pf_live *live, int64_t sensor, int64_t n, const int64_t *stamp, const double *before,
                          const double *now);

#ifdef __cplusplus
}
#endif
#endif
