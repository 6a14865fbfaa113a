/* A disk that fails, for LD_PRELOAD: what is written to recordings. The 64-bit number at the start
 * of the file FILE_FAULT: 0 none, above it the error of each write, sync and new file, -1 a disk
 * that takes nothing until it is 0 again. The number behind it counts what befell. */
#include "shim.h"
#include <errno.h>
#include <stdio.h>

static volatile int64_t *fault; /* and behind it the count */

__attribute__((constructor)) static void open_fault(void)
{
    fault = shim_numbers("FILE_FAULT");
}

static int is_recording(const char *path)
{
    size_t size = strlen(path);
    return size > 5 && strcmp(path + size - 5, ".mcap") == 0;
}

static int fails(const char *path, int file)
{
    char link[64], target[4096];
    if (!fault || !*fault)
        return 0;
    if (!path) {
        snprintf(link, sizeof link, "/proc/self/fd/%d", file);
        ssize_t size = readlink(link, target, sizeof target - 1);
        target[size < 0 ? 0 : size] = 0;
        path = target;
    }
    if (!is_recording(path))
        return 0;
    __atomic_add_fetch(fault + 1, 1, __ATOMIC_RELAXED);
    while (*fault == -1)
        usleep(10000);
    errno = (int)*fault;
    return errno != 0;
}

ssize_t write(int file, const void *data, size_t size)
{
    static ssize_t (*real)(int, const void *, size_t);
    if (!real)
        real = (ssize_t (*)(int, const void *, size_t))dlsym(RTLD_NEXT, "write");
    return fails(NULL, file) ? -1 : real(file, data, size);
}

int fdatasync(int file)
{
    static int (*real)(int);
    if (!real)
        real = (int (*)(int))dlsym(RTLD_NEXT, "fdatasync");
    return fails(NULL, file) ? -1 : real(file);
}

int open64(const char *path, int flags, ...)
{
    if (flags & O_CREAT && fails(path, -1))
        return -1;
    va_list more;
    va_start(more, flags);
    int file = system_open64(path, flags, more);
    va_end(more);
    return file;
}
