/* What somebody has to put into words: frames that the gate held back, emergencies, a fault; each with all that the
   controller remembered at that moment. Nothing here waits: one for which there is no room is counted. */
#ifndef TOLD_H
#define TOLD_H

#include "frame.h"
#include "pkxyz.h"

void told_begin(pkxyz_shared *shared);
void told_frames(int64_t told, int64_t t_us);
void told_emergency(const frame *came, int64_t told, int64_t t_us);
void told_fault(int64_t t_us);

#endif
