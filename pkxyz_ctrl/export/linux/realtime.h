/* Asks the system for what a loop at rate needs, and says in a line what it did not get. Never a failure. */
#ifndef REALTIME_H
#define REALTIME_H

void go_real_time(int priority, char *said, int size);
void leave_real_time(void);

#endif
