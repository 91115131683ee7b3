/* orders.c with nothing around it but what a test says of the controller: for ctypes. */
#include "controller.h"
#include "ending.h"
#include "orders.h"

static int mode, asked, requested;

int controller_mode(void) { return mode; }
int controller_is_closed(void) { return mode == PKXYZ_MODE_TRACKING; }
void controller_request(int event) { requested = event; }
void controller_clear(void) {}
void controller_change_law(const pkxyz_law_change_change *change) { (void)change; }
void ending_ask(int outcome) { asked = outcome; }

void alone_begin(pkxyz_shared *shared) { mode = asked = requested = 0; orders_begin(shared, -1); }
void alone_mode(int is) { mode = is; }
int alone_asked(void) { return asked; }
int alone_requested(void) { return requested; }
