#define _GNU_SOURCE
#include "leave.h"

#include <limits.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "frame.h"
#include "ring.h"

static const uint8_t *room;
static int64_t room_size;

static void get(int64_t at, void *to, int64_t count)
{
    for (int64_t n = 0; n < count; n++)
        ((uint8_t *)to)[n] = room[(at + n) % room_size];
}

/* The journal, cut off behind its first line. */
static FILE *journal_in(const char *folder)
{
    char path[PATH_MAX];
    snprintf(path, sizeof path, "%s/recording.parquet.journal", folder);
    FILE *file = fopen(path, "r+b");
    int byte = 0;
    while (file && byte != '\n' && (byte = getc(file)) != EOF) {
    }
    if (!file || byte == EOF || ftruncate(fileno(file), ftell(file)) != 0) {
        if (file)
            fclose(file);
        return 0;
    }
    fseek(file, 0, SEEK_END);
    return file;
}

static void print_frame(FILE *log, const char *name, const uint8_t *head, const uint8_t *data)
{
    int64_t t_us;
    uint32_t can_id;
    const int flags = head[0] >> 1, length = head[1], is_wide = (flags & (FRAME_EXTENDED | FRAME_ERROR)) != 0;
    memcpy(&t_us, head + 2, 8);
    memcpy(&can_id, head + 10, 4);
    if (flags & FRAME_ERROR)
        can_id |= 0x20000080; /* CAN_ERR_FLAG and the class of errors on the bus */
    fprintf(log, "(%lld.%06lld) %s %0*X#", (long long)(t_us / 1000000), (long long)(t_us % 1000000), name, is_wide ? 8 : 3,
            can_id);
    if (flags & FRAME_FD)
        fprintf(log, "#%d", flags & FRAME_FAST ? 1 : 0);
    if (flags & FRAME_REMOTE)
        fprintf(log, length ? "R%d" : "R", length);
    for (int n = 0; n < length && !(flags & FRAME_REMOTE); n++)
        fprintf(log, "%02X", data[n]);
    putc('\n', log);
}

int leave(const pkxyz_shared_ring *ring, const uint8_t *bytes, int64_t size, const char *folder, const char *channel)
{
    char path[PATH_MAX];
    const char *slash = strrchr(channel, '/');
    room = bytes;
    room_size = size;
    snprintf(path, sizeof path, "%s/frames.log", folder);
    FILE *rows = journal_in(folder), *log = rows ? fopen(path, "w") : 0;
    for (int64_t at = 0; log && at < ring->head;) {
        uint8_t head[RING_FRAME_HEAD], data[FRAME_BYTES];
        pkxyz_row row;
        get(at, head, 1);
        if (head[0] == RING_ROW) {
            get(at + 1, &row, sizeof row);
            fwrite(&row, sizeof row, 1, rows);
            at += 1 + (int64_t)sizeof row;
        } else if (head[0] == RING_END) {
            break;
        } else {
            get(at, head, sizeof head);
            get(at + RING_FRAME_HEAD, data, head[1]);
            print_frame(log, slash ? slash + 1 : channel, head, data);
            at += RING_FRAME_HEAD + head[1];
        }
    }
    const int failed = !log || ferror(rows) || ferror(log);
    if (rows)
        fclose(rows);
    if (log)
        fclose(log);
    return failed ? -1 : 0;
}
