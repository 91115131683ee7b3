/* Files of the host, by semihosting. */
#ifndef HOST_FILES_H
#define HOST_FILES_H

#include <stddef.h>
#include <stdint.h>

enum { SYS_OPEN = 1, SYS_CLOSE = 2, SYS_WRITE = 5, SYS_READ = 6, TO_READ = 1, TO_WRITE = 5 };

int port_semihosting(int operation, const void *argument);

static inline uint32_t opened(const char *name, uint32_t length, uint32_t mode)
{
    const uint32_t words[3] = {(uint32_t)name, mode, length};
    return (uint32_t)port_semihosting(SYS_OPEN, words);
}

/* 1 if that many bytes were moved, else 0. */
static inline int moved(int operation, uint32_t file, const void *bytes, size_t size)
{
    const uint32_t words[3] = {file, (uint32_t)bytes, size};
    return port_semihosting(operation, words) == 0;
}

static inline void closed(uint32_t file)
{
    port_semihosting(SYS_CLOSE, &file);
}

#endif
