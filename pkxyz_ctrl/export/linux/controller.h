/* The controller as the loop sees it: the exported calls, each with what they leave to be sent. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include "frame.h"
#include "pkxyz.h"

/* The controller's records stand in what is shared: config is read, but for a change of law; memory is all that it remembers. */
void controller_begin(pkxyz_shared *shared);

/* Goes through a period with a copy of the memory, so that nothing is done for the first time later. */
void controller_warm_up(void);

int controller_mode(void);
int controller_is_closed(void); /* whether the loop is closed in this mode */
int controller_status(void);    /* of the first call that failed; 0: none did */
void controller_request(int event);
void controller_clear(void);
void controller_change_law(const pkxyz_law_change_change *change); /* between two ticks */

void controller_start(int64_t t_us);

/* One step of the start-up, with a frame that came or 0: 1 once periods may begin, -1 if it failed. */
int controller_come_up(const frame *came, int64_t t_us);

void controller_sync(int64_t t_us);
void controller_rehearse(const pkxyz_reference *rows, int32_t count); /* while the sample is on its way: the caches then hold
                                                                         what the answer to it takes */
int controller_take(const frame *came, int64_t t_us); /* 1 once this period's sense values are in */
void controller_compute(const pkxyz_reference *rows, int32_t count, int32_t overrun);
void controller_finish(int64_t t_us, int64_t heartbeat_until_us);
void controller_stop(int64_t t_us);

#endif
