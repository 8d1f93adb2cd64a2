/* A controller's loop with the filter of pumafuse in it; to copy.

       pumafuse export -c fusion.toml -o filter.h
       c++ -std=c++20 -O3 -ffp-contract=off -Icore/include -c core/pumafuse.cpp
       cc -std=c99 -O2 -I. -Icore/include -o controller examples/controller.c pumafuse.o -lstdc++ -lm
       ./controller < events.txt

   A thousand times a second it takes in what has arrived, and then knows where the arm is. Here what arrives are lines
   of standard input, in the order in which they come, and no tick waits for a clock:

       ARRIVAL_NS SOURCE STAMP_NS VALUE...

   SOURCE is -1 for a command, else the sensor's number in filter.h. There is a VALUE for each axis, in m (rad), "nan"
   where the event gives none. Each tick prints its instant and, of each axis, position, velocity and the standard
   deviation of both, as hexadecimal floats: they lose no bit. */

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "filter.h"

#define TICK_NS 1000000

/* How late an event may come. The filter then goes back to its stamp and runs on from there: a tick takes the longer
   the later an event is, and this is what bounds it. */
#define WINDOW_NS 2000000000

/* Events that are kept: those of the window, and commands that do not act yet. With more than that the window gets
   shorter. A command counts once for each delay that differs between axes. */
#define ROOM 4096

struct event {
    int64_t arrival, source, stamp;
    double value[FILTER_AXES];
};

static pf_live *live;
static pf_port *port;
static int64_t newest = PF_ALWAYS; /* of all stamps */
static long outcomes[PF_UNKNOWN + 1]; /* of the values that the sensors gave */

/* The next line; 0 at the end of them. In a controller: the next message of the bus. */
static int next(struct event *event)
{
    static char line[4096];
    if (fgets(line, sizeof line, stdin) == NULL) return 0;
    char *at = line;
    event->arrival = strtoll(at, &at, 10);
    event->source = strtoll(at, &at, 10);
    event->stamp = strtoll(at, &at, 10);
    int wrong = event->source < PF_COMMAND || event->source >= FILTER_SENSORS; /* the filter itself does not check */
    for (int a = 0; a < FILTER_AXES; a++) {
        char *value = at;
        event->value[a] = strtod(value, &at);
        wrong |= at == value;
    }
    if (wrong) {
        fprintf(stderr, "no event: %s", line);
        exit(1);
    }
    return 1;
}

static void take(const struct event *event)
{
    uint64_t given = 0;
    for (int a = 0; a < FILTER_AXES; a++) {
        port->value[a] = event->value[a];
        if (event->value[a] == event->value[a]) given |= UINT64_C(1) << a; /* not NaN */
    }
    /* Time is that of the stamps. All must be of one clock: a sensor that ran ahead would make all others late. */
    if (event->stamp > newest) newest = event->stamp;
    int64_t oldest = newest - WINDOW_NS;
    if (oldest < port->floor) oldest = port->floor; /* there was no room for what is older */

    int taken = 0;
    if (event->stamp >= oldest) taken = pf_live_add(live, event->stamp, event->source, given, oldest);
    for (int a = 0; a < FILTER_AXES; a++)
        if (event->source != PF_COMMAND && given >> a & 1) outcomes[taken == 1 ? port->outcome[a] : PF_TOO_LATE]++;
}

int main(void)
{
    static char input[65536], output[65536]; /* else the standard library allocates them in the loop */
    setvbuf(stdin, input, _IOFBF, sizeof input);
    setvbuf(stdout, output, _IOFBF, sizeof output);

    if (pf_version() != PF_VERSION) {
        fprintf(stderr, "the library is of interface %d, this program of %d\n", pf_version(), PF_VERSION);
        return 1;
    }
    live = pf_live_new(&filter_model, ROOM, ROOM); /* room at first, and at the most: all memory is taken here */
    if (live == NULL) {
        fprintf(stderr, "no filter: %s\n", pf_error());
        return 1;
    }
    port = pf_live_port(live);

    struct event event;
    int more = next(&event);
    for (int64_t now = more ? event.arrival : 0; more; now += TICK_NS) { /* in a controller: wait until then */
        for (; more && event.arrival <= now; more = next(&event)) take(&event);
        if (now < port->origin) continue; /* where the arm was before its first command nobody knows */

        /* Where it is now. To correct the next command ask for the instant at which that one will act: a tick and the
           arm's delay ahead. `fused` is when the last measurement was valid: where that is long ago, hold still. */
        double found[PF_OUTPUTS][FILTER_AXES];
        int64_t fused[FILTER_AXES];
        pf_live_estimate(live, now, PF_NEVER, &found[0][0], fused);
        printf("%" PRId64, now);
        for (int a = 0; a < FILTER_AXES; a++)
            printf(" %a %a %a %a", found[PF_POSITION][a], found[PF_VELOCITY][a], found[PF_POSITION_SD][a],
                   found[PF_VELOCITY_SD][a]);
        printf("\n");
    }
    fprintf(stderr, "%ld values fused, %ld rejected, %ld reacquired, %ld duplicate, %ld too late\n", outcomes[PF_FUSED],
            outcomes[PF_REJECTED], outcomes[PF_REACQUIRED], outcomes[PF_DUPLICATE], outcomes[PF_TOO_LATE]);
    pf_live_free(live);
    return 0;
}
