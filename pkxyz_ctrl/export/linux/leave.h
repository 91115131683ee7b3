/* After a run that nobody records beside it: rows and frames out of the ring, into files. */
#ifndef LEAVE_H
#define LEAVE_H

#include "pkxyz.h"

/* Rows go behind the first line of folder/recording.parquet.journal, which says what they are, in place of what is
   there; frames to folder/frames.log, as candump -L writes them. 0, or -1 and errno. */
int leave(const pkxyz_shared_ring *ring, const uint8_t *bytes, int64_t size, const char *folder, const char *channel);

#endif
