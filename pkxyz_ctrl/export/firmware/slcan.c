#include "slcan.h"

#include "uart.h"

enum { LINE_MOST = 1 + 8 + 1 + 2 * 64, OK = '\r', REFUSED = '\a' };

static const uint8_t fd_length[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64};

static void put_hex(uint32_t value, int digits)
{
    while (digits-- > 0)
        uart_put("0123456789ABCDEF"[value >> 4 * digits & 15]);
}

/* The number of so many digits; -1 where one of them is none. */
static int64_t hex(const char *text, int digits)
{
    int64_t value = 0;
    while (digits-- > 0) {
        const char c = *text++, low = (char)(c | 0x20);
        if (c >= '0' && c <= '9')
            value = value << 4 | (c - '0');
        else if (low >= 'a' && low <= 'f')
            value = value << 4 | (low - 'a' + 10);
        else
            return -1;
    }
    return value;
}

void slcan_send(const can_frame *frame)
{
    const int is_extended = (frame->flags & FRAME_EXTENDED) != 0;
    const char kind = frame->flags & FRAME_REMOTE ? 'r' : frame->flags & FRAME_FAST ? 'b' : frame->flags & FRAME_FD ? 'd' : 't';
    uart_put((char)(is_extended ? kind - 0x20 : kind));
    put_hex((uint32_t)frame->can_id, is_extended ? 8 : 3);
    put_hex((uint32_t)frame->length, 1); /* what the controller sends has eight bytes at most */
    for (int n = 0; n < frame->length && !(frame->flags & FRAME_REMOTE); n++)
        put_hex((uint32_t)(frame->data >> 8 * n) & 255, 2);
    uart_put(OK);
}

/* A line without its end as a frame: 1 if it is one. */
static int read_frame(const char *line, int count, can_frame *frame)
{
    const char kind = (char)(line[0] | 0x20);
    const int is_extended = kind != line[0], digits = is_extended ? 8 : 3;
    if (count < 2 + digits || (kind != 't' && kind != 'r' && kind != 'd' && kind != 'b'))
        return 0;
    const int64_t can_id = hex(line + 1, digits), code = hex(line + 1 + digits, 1);
    if (can_id < 0 || code < 0)
        return 0;
    frame->can_id = (int32_t)can_id;
    frame->flags = (is_extended ? FRAME_EXTENDED : 0) | (kind == 'r' ? FRAME_REMOTE : 0)
                   | (kind == 'd' ? FRAME_FD : kind == 'b' ? FRAME_FD | FRAME_FAST : 0);
    frame->length = fd_length[code];
    frame->data = 0;
    if (kind == 'r')
        return 1;
    if (count < 2 + digits + 2 * frame->length)
        return 0;
    for (int n = 0; n < frame->length && n < 8; n++) {
        const int64_t byte = hex(line + 2 + digits + 2 * n, 2);
        if (byte < 0)
            return 0;
        frame->data |= (int64_t)((uint64_t)byte << 8 * n);
    }
    return 1;
}

void slcan_receive(can_frame *frame)
{
    static char line[LINE_MOST];
    for (;;) {
        int count = 0;
        for (char c = uart_get(); c != OK; c = uart_get())
            if (count < LINE_MOST)
                line[count++] = c;
        if (count == 0)
            continue;
        if (read_frame(line, count, frame))
            return;
        /* Open, close and bit rate: there is nothing to set here. */
        uart_put(line[0] == 'O' || line[0] == 'C' || line[0] == 'S' || line[0] == 'Y' || line[0] == 'L' ? OK : REFUSED);
    }
}
