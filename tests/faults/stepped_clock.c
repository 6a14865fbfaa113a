/* A wall clock that can be stepped while a program runs, for LD_PRELOAD: what it reads is moved by
 * the 64-bit number of nanoseconds at the start of the file STEPPED_CLOCK. Monotonic clocks go on. */
#include "shim.h"
#include <sys/time.h>
#include <time.h>

static volatile const int64_t *step_ns;
static int (*real_clock_gettime)(clockid_t, struct timespec *);

__attribute__((constructor)) static void open_step(void)
{
    real_clock_gettime = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    step_ns = shim_numbers("STEPPED_CLOCK");
}

int clock_gettime(clockid_t clock, struct timespec *now)
{
    if (!real_clock_gettime) /* another library's constructor came first */
        open_step();
    int status = real_clock_gettime(clock, now);
    if (status == 0 && step_ns && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) {
        int64_t total_ns = now->tv_sec * INT64_C(1000000000) + now->tv_nsec + *step_ns;
        now->tv_sec = total_ns / 1000000000;
        now->tv_nsec = total_ns % 1000000000;
    }
    return status;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone)
{
    struct timespec exact;
    (void)zone;
    int status = clock_gettime(CLOCK_REALTIME, &exact);
    if (status == 0) {
        now->tv_sec = exact.tv_sec;
        now->tv_usec = exact.tv_nsec / 1000;
    }
    return status;
}

time_t time(time_t *result)
{
    struct timespec exact;
    time_t now = clock_gettime(CLOCK_REALTIME, &exact) == 0 ? exact.tv_sec : (time_t)-1;
    if (result)
        *result = now;
    return now;
}
