/* A board that is held back, for LD_PRELOAD: where the Pi's firmware says by what, the 64-bit number
 * at the start of the file BOARD_STATE stands instead, 0 for a board that says nothing. */
#include "shim.h"
#include <stdio.h>

static volatile const int64_t *bits;

__attribute__((constructor)) static void open_bits(void)
{
    bits = shim_numbers("BOARD_STATE");
}

int open64(const char *path, int flags, ...)
{
    const char *name = strrchr(path, '/');
    if (bits && *bits && name && strcmp(name, "/get_throttled") == 0) {
        int file = memfd_create("get_throttled", MFD_CLOEXEC);
        if (file >= 0) {
            dprintf(file, "%llx\n", (unsigned long long)*bits);
            lseek(file, 0, SEEK_SET);
            return file;
        }
    }
    va_list more;
    va_start(more, flags);
    int file = system_open64(path, flags, more);
    va_end(more);
    return file;
}
