/* A board that is held back, for LD_PRELOAD: where the Pi's firmware says by what, the 64-bit number
 * at the start of the file BOARD_STATE stands instead, 0 for a board that says nothing. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

static volatile const int64_t *bits;

__attribute__((constructor)) static void open_bits(void)
{
    const char *path = getenv("BOARD_STATE");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    if (file < 0)
        return;
    void *mapped = mmap(NULL, sizeof(int64_t), PROT_READ, MAP_SHARED, file, 0);
    close(file);
    if (mapped != MAP_FAILED)
        bits = mapped;
}

int open64(const char *path, int flags, ...)
{
    static int (*real)(const char *, int, ...);
    va_list more;
    va_start(more, flags);
    int mode = flags & (O_CREAT | __O_TMPFILE) ? va_arg(more, int) : 0;
    va_end(more);
    const char *name = strrchr(path, '/');
    if (bits && *bits && name && strcmp(name, "/get_throttled") == 0) {
        int file = memfd_create("get_throttled", MFD_CLOEXEC);
        if (file >= 0) {
            dprintf(file, "%llx\n", (unsigned long long)*bits);
            lseek(file, 0, SEEK_SET);
            return file;
        }
    }
    if (!real)
        real = (int (*)(const char *, int, ...))dlsym(RTLD_NEXT, "open64");
    return real(path, flags, mode);
}
