#include "notes.h"

#include "debugger.h"

enum { WRITE_BINARY = 5, NOTES_MOST = 255 };

static uint32_t file;
static int32_t count;

static void written(const void *bytes, size_t size)
{
    const uint32_t words[3] = {file, (uint32_t)bytes, size};
    if (port_semihosting(SYS_WRITE, words) != 0) {
        port_print("pkxyz: the notes could not be written");
        port_exit(4);
    }
}

void notes_open(void)
{
    const uint32_t words[3] = {(uint32_t)"notes", WRITE_BINARY, 5};
    file = (uint32_t)port_semihosting(SYS_OPEN, words);
}

void note(const note_head *head, const pkxyz_exchange_memory *memory)
{
    if (count == NOTES_MOST)
        return;
    written(head, sizeof *head);
    written(memory, PKXYZ_MEMORY_BYTES);
    count++;
}

int32_t notes_count(void)
{
    return count;
}

void notes_taken(void)
{
    const uint32_t words[2] = {file, 0};
    if (count > 0)
        port_semihosting(SYS_SEEK, words);
    count = 0;
}
