/* loop FILE: control one stage at rate, as FILE says, and leave rows and frames in the folder "run" beside it.
   loop FILE PIPE: what happens stands in FILE, and is taken from there by whoever reads the pipe as long as he does.
   loop FILE PIPE WAKE: the same, and he is told of each tick by that eventfd. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "clock.h"
#include "controller.h"
#include "ending.h"
#include "leave.h"
#include "loop.h"
#include "orders.h"
#include "path.h"
#include "port.h"
#include "ring.h"
#include "ticks.h"
#include "told.h"

static const char *const WORDS[] = {
    "", "done", "ended from outside", "the bus can't be had", "the amplifier could not be brought to operation",
    "the amplifier has fallen silent", "nobody takes the rows any more", "the path was not sampled in time",
    "a kernel failed", "nobody gives orders any more", "the set-points were not made in time",
};

static int refuse(const char *file, const char *words)
{
    fprintf(stderr, "loop: %s: %s\n", file, words);
    return 2;
}

/* The whole file, in memory now and not when it is first needed; where it is not shared it stays as it is. */
static pkxyz_shared *mapped(const char *file, int is_shared, int64_t *size)
{
    struct stat found;
    const int opened = open(file, (is_shared ? O_RDWR : O_RDONLY) | O_CLOEXEC);
    if (opened < 0 || fstat(opened, &found) != 0)
        return 0;
    *size = found.st_size;
    const int how = (is_shared ? MAP_SHARED : MAP_PRIVATE) | MAP_POPULATE;
    void *place = mmap(0, (size_t)found.st_size, PROT_READ | PROT_WRITE, how, opened, 0);
    close(opened);
    return place == MAP_FAILED ? 0 : place;
}

static const char *misfit(const pkxyz_shared *shared, int64_t size)
{
    const pkxyz_shared_settings *settings = shared->settings;
    if (size < (int64_t)sizeof *shared || settings->magic != PKXYZ_MAGIC)
        return "is not what this program goes by";
    if (settings->layout != PKXYZ_LAYOUT)
        return "was written for another version of this program; build both anew";
    if (settings->blocks < 1 || settings->ring_bytes < 1 ||
        size != (int64_t)sizeof *shared + settings->blocks * (int64_t)sizeof(pkxyz_shared_path) + settings->ring_bytes)
        return "is cut short";
    return 0;
}

int main(int argc, char **argv)
{
    int64_t size = 0;
    if (argc < 2 || argc > 4)
        return refuse("FILE [PIPE]", "give the file that says what to do");
    pkxyz_shared *shared = mapped(argv[1], argc > 2, &size);
    if (!shared)
        return refuse(argv[1], strerror(errno));
    const char *wrong = misfit(shared, size);
    if (wrong)
        return refuse(argv[1], wrong);
    pkxyz_shared_settings *settings = shared->settings;
    pkxyz_shared_state *state = shared->state;
    pkxyz_shared_path *blocks = (void *)(shared + 1);
    uint8_t *ring_bytes = (uint8_t *)(blocks + settings->blocks);

    ending_begin(argc > 2 ? atoi(argv[2]) : -1, settings->is_operated);
    clock_begin(settings->spin_us);
    state->begun_ns = clock_begun_ns();
    path_begin(blocks, settings->blocks);
    ring_begin(shared->ring, ring_bytes, settings->ring_bytes);
    told_begin(shared);
    orders_begin(shared, argc > 3 ? atoi(argv[3]) : -1);
    controller_begin(shared);
    ticks_begin(settings, state);

    int outcome = PKXYZ_OUTCOME_REFUSED;
    if (port_open(settings, state, (char *)state->refusal, sizeof state->refusal) == 0) {
        outcome = loop(shared);
        port_close();
    }
    state->signal = ending_signal();
    state->status = controller_status();
    state->outcome = outcome;
    atomic_store_explicit((_Atomic int32_t *)&state->phase, PKXYZ_PHASE_ENDED, memory_order_release);
    ring_end();
    if (argc == 2) { /* nobody else records it, or puts it into words */
        char folder[PATH_MAX];
        const char *slash = strrchr(argv[1], '/');
        snprintf(folder, sizeof folder, "%.*srun", slash ? (int)(slash + 1 - argv[1]) : 0, argv[1]);
        if (leave(shared->ring, ring_bytes, settings->ring_bytes, folder, (const char *)settings->channel) != 0)
            return refuse(folder, strerror(errno));
        fprintf(stderr, "loop: %s\nloop: %s%s%s; %lld ticks, %lld of %lld rows lost\n", state->real_time, WORDS[outcome],
                *state->refusal ? ": " : "", state->refusal, (long long)state->ticks, (long long)shared->ring->lost_rows,
                (long long)settings->ticks);
    }
    return outcome == PKXYZ_OUTCOME_DONE ? 0 : 1;
}
