/* Ctrl-C, SIGTERM and SIGHUP, taken note of where they may end something and not in the middle of it. */
#ifndef ENDING_H
#define ENDING_H

/* recorder: the end of a pipe that somebody reads for as long as rows are taken, or orders given; -1: nobody does. */
void ending_begin(int recorder, int is_operated);

/* Why the end was asked for, a PKXYZ_OUTCOME; 0 if nobody did. */
int ending_asked(void);
int ending_signal(void);

/* For the loop itself: it can't go on. */
void ending_ask(int outcome);

/* Once a tick: is whoever reads the pipe still there? */
void ending_look(void);

#endif
