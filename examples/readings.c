/* A sensor's loop that sends each measurement to pumafuse; to copy.

       cc -std=c11 -O2 -o readings examples/readings.c -lm && ./readings HOST PORT [SECONDS]

   A hundred times a second the sensor is read. The measurement goes as a datagram to `pumafuse live udp://...`, under
   the sensor's name in fusion.toml. Axes that it does not measure are left out. POSIX. */

#define _POSIX_C_SOURCE 200809L
#include <inttypes.h>
#include <math.h>
#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>

#define SENSOR "tracker" /* its name in fusion.toml */
#define PERIOD_NS 10000000LL
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

/* Noise of about 0.05 mm. */
static double noise_mm(void)
{
    double sum = 0.0;
    for (int part = 0; part < 12; part++)
        sum += rand() / (double)RAND_MAX;
    return 0.05 * (sum - 6.0);
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
    for (int64_t row = 0; row * PERIOD_NS / 1e9 < seconds; row++) {
        sleep_until(begin + row * PERIOD_NS);
        const int64_t stamp = now_ns(CLOCK_REALTIME); /* when it arrives; it is valid latency_ms of fusion.toml before */
        /* The measurement: here where commands.c sent the arm 0.1 s ago, with noise. */
        const double x_mm = 560.0 + 20.0 * sin(0.2 * PI * (stamp / 1e9 - 0.1)) + noise_mm();
        char line[256];
        const int length = snprintf(line, sizeof line,
                                    "{\"t_ns\": %" PRId64 ", \"sensor\": \"" SENSOR "\", "
                                    "\"x\": %.6f, \"y\": %.6f, \"z\": %.6f}",
                                    stamp, x_mm, noise_mm(), -100.0 + noise_mm());
        sendto(link, line, (size_t)length, MSG_DONTWAIT, place->ai_addr, place->ai_addrlen); /* the next one may do */
    }
    freeaddrinfo(place);
    return 0;
}
