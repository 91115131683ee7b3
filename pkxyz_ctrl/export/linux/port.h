/* The loop's connection to a bus: whichever it is, what goes and comes is counted, stamped and recorded here. */
#ifndef PORT_H
#define PORT_H

#include "frame.h"
#include "pkxyz.h"

/* What a bus has to be able to do. Nothing here waits. */
typedef struct {
    int (*open)(const pkxyz_shared_settings *settings, char *why, int size); /* 0, or -1 and why not */
    int (*send)(const frame *sent);                                          /* 0, or an errno */
    int (*take)(frame *taken);    /* 1: a frame, 0: none is there, -1: it can't be read */
    void (*look)(void);           /* between ticks, for what may take its time */
    void (*discard)(void);        /* what still waits to be sent is not to be sent */
    int (*others)(void);          /* other participants, -1 where that is not known */
    int64_t (*dropped)(void);     /* frames that a full receiver has lost */
    int64_t (*patience_us)(void); /* for how long at most it can be slept upon */
    int (*descriptor)(void);      /* readable when a frame may be there */
    void (*close)(void);
} bus;

extern const bus unix_bus, can_bus;

int port_open(const pkxyz_shared_settings *settings, pkxyz_shared_state *state, char *why, int size);

/* Hands one of the controller's frames to the bus. A frame that it refuses is lost, and counted. */
void port_send(const pkxyz_driver_rules_outgoing *out);

/* 1: the next frame; 0 once it is deadline_us. One that already waits comes even after that. */
int port_receive(int64_t deadline_us, frame *taken);

void port_look(void);
void port_discard(void);
void port_close(void);

#endif
