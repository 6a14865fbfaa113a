/* An x264 that stalls, for LD_PRELOAD. The 64-bit number at the start of the file ENCODER_FAULT:
 * 0 it encodes, 1 it takes pictures and gives none, 2 it does not come back from a call. */
#include "shim.h"
#include <link.h>

static volatile const int64_t *fault;

__attribute__((constructor)) static void open_fault(void)
{
    fault = shim_numbers("ENCODER_FAULT");
}

/* The encoder was loaded by a plug-in and is in nobody's default scope. */
static int find(struct dl_phdr_info *library, size_t size, void *found)
{
    (void)size;
    if (!strstr(library->dlpi_name, "libx264"))
        return 0;
    *(void **)found = dlsym(dlopen(library->dlpi_name, RTLD_NOW), "x264_encoder_encode");
    return 1;
}

int x264_encoder_encode(void *encoder, void **units, int *count, void *picture, void *out)
{
    static int (*real)(void *, void **, int *, void *, void *);
    if (!real)
        dl_iterate_phdr(find, &real);
    while (fault && *fault == 2)
        usleep(10000);
    if (fault && *fault == 1) {
        *units = NULL;
        *count = 0;
        return 0;
    }
    return real(encoder, units, count, picture, out);
}
