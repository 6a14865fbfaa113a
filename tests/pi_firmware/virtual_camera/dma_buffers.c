/*
 * Preloaded into a program, stands in for /dev/udmabuf where the kernel has none: libcamera's
 * virtual pipeline takes its buffers from there. A buffer is then plain memory behind a file.
 *
 * It paces the virtual camera, too, which else runs as fast as it can: the pipeline maps a buffer,
 * for writing only, to paint a frame, and that waits for the frame's turn at 30 Hz. That a
 * frame is never done before it was asked for is what libcamerasrc relies on.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <linux/dma-buf.h>
#include <linux/udmabuf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#define PERIOD_NS 33333333LL

static const char DEVICE[] = "/dev/udmabuf";

static int open_next(const char *name, const char *path, int flags, mode_t mode)
{
	if (strcmp(path, DEVICE) == 0)
		return memfd_create("udmabuf", MFD_CLOEXEC);
	int (*next)(const char *, int, ...) = dlsym(RTLD_NEXT, name);
	return next(path, flags, mode);
}

int open(const char *path, int flags, ...)
{
	va_list rest;
	va_start(rest, flags);
	mode_t mode = va_arg(rest, mode_t);
	va_end(rest);
	return open_next("open", path, flags, mode);
}

int open64(const char *path, int flags, ...)
{
	va_list rest;
	va_start(rest, flags);
	mode_t mode = va_arg(rest, mode_t);
	va_end(rest);
	return open_next("open64", path, flags, mode);
}

static void await_turn(void)
{
	static long long next_ns;
	struct timespec now;
	clock_gettime(CLOCK_MONOTONIC, &now);
	long long now_ns = now.tv_sec * 1000000000LL + now.tv_nsec;
	if (next_ns < now_ns - PERIOD_NS)
		next_ns = now_ns;
	next_ns += PERIOD_NS;
	struct timespec until = { next_ns / 1000000000LL, next_ns % 1000000000LL };
	clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL);
}

int ioctl(int file, unsigned long request, ...)
{
	va_list rest;
	va_start(rest, request);
	void *argument = va_arg(rest, void *);
	va_end(rest);
	if ((request & 0xffffffff) == UDMABUF_CREATE) {
		struct udmabuf_create *create = argument;
		return fcntl((int)create->memfd, F_DUPFD_CLOEXEC, 0);
	}
	if ((request & 0xffffffff) == DMA_BUF_IOCTL_SYNC)
		return 0;
	int (*next)(int, unsigned long, ...) = dlsym(RTLD_NEXT, "ioctl");
	return next(file, request, argument);
}

void *mmap(void *at, size_t size, int protection, int flags, int file, off_t offset)
{
	if (protection == PROT_WRITE && (flags & MAP_SHARED) && file >= 0)
		await_turn();
	return (void *)syscall(SYS_mmap, at, size, protection, flags, file, offset);
}

void *mmap64(void *at, size_t size, int protection, int flags, int file, off64_t offset)
{
	return mmap(at, size, protection, flags, file, offset);
}
