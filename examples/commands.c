/* A robot controller's loop that sends each command to pumafuse; to copy.

       cc -std=c11 -O2 -o commands examples/commands.c -lm && ./commands HOST PORT [SECONDS]

   Every 28 ms, by a clock that does not drift, a position goes to the arm and, as a datagram, to
   `pumafuse live udp://...`. A datagram never makes the loop wait, whether anybody receives it or not. POSIX. */

#define _POSIX_C_SOURCE 200809L
#include <inttypes.h>
#include <math.h>
#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>

#define PERIOD_NS 28000000LL
#define SECOND_NS 1000000000LL
#define PI 3.14159265358979323846

static int64_t now_ns(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * SECOND_NS + now.tv_nsec;
}

static void sleep_until(int64_t due_ns)
{
    struct timespec due = {.tv_sec = due_ns / SECOND_NS, .tv_nsec = due_ns % SECOND_NS};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL) != 0) {
    }
}

int main(int argc, char **argv)
{
    if (argc < 3) {
        fprintf(stderr, "usage: %s HOST PORT [SECONDS]\n", argv[0]);
        return 2;
    }
    const double seconds = argc > 3 ? atof(argv[3]) : INFINITY;
    struct addrinfo hints = {.ai_socktype = SOCK_DGRAM}, *place;
    if (getaddrinfo(argv[1], argv[2], &hints, &place) != 0) {
        fprintf(stderr, "no address of %s:%s is known\n", argv[1], argv[2]);
        return 1;
    }
    const int link = socket(place->ai_family, SOCK_DGRAM, 0);
    if (link < 0) {
        perror("socket");
        return 1;
    }
    const int64_t begin = now_ns(CLOCK_MONOTONIC);
    for (int64_t tick = 0; tick * PERIOD_NS / 1e9 < seconds; tick++) {
        sleep_until(begin + tick * PERIOD_NS);
        const int64_t stamp = now_ns(CLOCK_REALTIME); /* when the arm gets it, on the clock of the sensor's stamps */
        /* The command: here 20 mm to and fro in 10 s. */
        const double x_mm = 560.0 + 20.0 * sin(0.2 * PI * stamp / 1e9);
        /* ... give the position to the arm here ... */
        char line[256];
        const int length = snprintf(line, sizeof line,
                                    "{\"t_ns\": %" PRId64 ", \"command\": {\"x\": %.6f, \"y\": 0.0, \"z\": -100.0}}",
                                    stamp, x_mm);
        sendto(link, line, (size_t)length, MSG_DONTWAIT, place->ai_addr, place->ai_addrlen); /* the robot must go on */
    }
    freeaddrinfo(place);
    return 0;
}
