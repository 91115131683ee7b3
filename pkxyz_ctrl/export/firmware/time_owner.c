/* Time is asked for and told in frames with identifiers of 29 bits that nobody else has on this line; they never reach
   the bus. Bytes 0 to 5 hold a time in us. A question is answered by NOW, and by a frame behind it where one came. */
#include "time_owner.h"

#include "notes.h"

enum {
    WAIT_UNTIL = 0x1ffffff0, /* time; byte 6: how many notes stand in the file */
    RECEIVE_UNTIL,           /* likewise */
    SPEND,                   /* a duration; no answer */
    DISCARD,                 /* no answer */
    NOW = 0x1ffffff8,        /* time; byte 6: frames that wait to go out; byte 7: FOLLOWS, CLEARING and IS_CLEARING */
    FOLLOWS = 1,
    CLEARING = 2,
    IS_CLEARING = 4
};
enum { TIME_BITS = 48 };

time_told now;

static void say(int32_t what, int64_t us, int32_t count)
{
    const can_frame frame = {us | (int64_t)count << TIME_BITS, what, FRAME_EXTENDED, 8};
    slcan_send(&frame);
}

/* Returns 1 if a frame follows. */
static int asked(int32_t what, int64_t us)
{
    can_frame told;
    say(what, us, notes_count());
    do
        slcan_receive(&told);
    while (told.can_id != NOW);
    notes_taken();
    const int32_t bits = (int32_t)(told.data >> TIME_BITS) & 0xffff;
    now.us = told.data & (((int64_t)1 << TIME_BITS) - 1);
    now.unsent = bits & 255;
    now.clearing = bits >> 8 & CLEARING ? (bits >> 8 & IS_CLEARING) != 0 : -1;
    return bits >> 8 & FOLLOWS;
}

void wait_until(int64_t t_us)
{
    asked(WAIT_UNTIL, t_us);
}

int receive_until(int64_t t_us, can_frame *frame)
{
    if (!asked(RECEIVE_UNTIL, t_us))
        return 0;
    slcan_receive(frame);
    return 1;
}

void spend(int64_t us)
{
    say(SPEND, us, 0);
    now.us += us;
}

void discard_unsent(void)
{
    say(DISCARD, 0, 0);
}
