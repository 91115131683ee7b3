/* How long the controller's own calls take, by the processor's own counter: 40 instructions a count where an emulator is
   told to take a nanosecond for each (-icount shift=0), 25 MHz on the board itself. */
#ifndef STOPWATCH_H
#define STOPWATCH_H

#include <stdint.h>

void stopwatch_open(void);
void stopwatch_start(void); /* from 0 */
void stopwatch_pause(void);
void stopwatch_go_on(void);
uint32_t stopwatch(void); /* counts, pauses excluded */

#endif
