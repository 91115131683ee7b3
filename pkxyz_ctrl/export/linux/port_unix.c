/* A bus among the processes of one user: a folder of sockets, each participant sends to all others. A frame is a
   datagram: ns of CLOCK_MONOTONIC, identifier with the flags of linux/can.h, length, flags of the FD frame, data. */
#define _GNU_SOURCE
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "clock.h"
#include "port.h"
#include "unix_folder.h"

enum { BIT_RATE_SWITCH = 1, FD_FRAME = 4, HEAD = 14, LONGEST = HEAD + FRAME_BYTES, DATAGRAM_MOST = 128 };
enum { OTHERS_MOST = 32, WAITING_MOST = 256, ATTEMPTS = 10, RETRY_US = 500, LEAVE_MS = 100, FOREIGN_MOST = 8 };
static const uint32_t EXTENDED = 0x80000000, REMOTE = 0x40000000, ERROR_FRAME = 0x20000000;

typedef struct {
    uint8_t length;
    uint8_t bytes[LONGEST];
} datagram;

/* Another participant, and what waits for room in its queue. Connected, a send does without a walk along its path, which
   takes as long as all the rest of it. */
typedef struct {
    struct sockaddr_un address;
    int descriptor; /* -1: not connected */
    int first, waiting;
    datagram queue[WAITING_MOST];
    int is_there; /* a mark while the folder is listed */
} participant;

static participant others[OTHERS_MOST];
static int others_count, waiting_in_all, descriptor = -1, carries_fd, is_named;
static struct sockaddr_un mine;
static char folder[sizeof mine.sun_path];
static int64_t listed_ns = -1, dropped;

/* Without malloc, which opendir calls. */
static void list_folder(void)
{
    _Alignas(8) char entries[4096];
    const int opened = open(folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    long count;
    for (int n = 0; n < others_count; n++)
        others[n].is_there = 0;
    while (opened >= 0 && (count = syscall(SYS_getdents64, opened, entries, sizeof entries)) > 0) {
        for (long at = 0; at < count;) {
            const struct dirent64 *entry = (const void *)(entries + at);
            at += entry->d_reclen;
            struct sockaddr_un address = {.sun_family = AF_UNIX};
            const int length = snprintf(address.sun_path, sizeof address.sun_path, "%s/%s", folder, entry->d_name);
            if (!is_our_name(entry->d_name) || length >= (int)sizeof address.sun_path)
                continue;
            if (strcmp(address.sun_path, mine.sun_path) == 0)
                continue;
            int known = 0;
            while (known < others_count && strcmp(others[known].address.sun_path, address.sun_path) != 0)
                known++;
            if (known == OTHERS_MOST)
                continue;
            if (known == others_count) {
                others[known].address = address;
                others[known].descriptor = -1;
                others[known].waiting = others[known].first = 0;
                others_count++;
            }
            others[known].is_there = 1;
        }
    }
    if (opened >= 0)
        close(opened);
}

static void disconnect(participant *other)
{
    if (other->descriptor >= 0)
        close(other->descriptor);
    other->descriptor = -1;
}

static void forget(int number)
{
    disconnect(&others[number]);
    waiting_in_all -= others[number].waiting;
    others_count--;
    if (number != others_count)
        others[number] = others[others_count];
}

/* A folder's time is that of the kernel's last tick, up to 10 ms coarse: what is younger may change unseen. */
static void look(void)
{
    struct stat found;
    struct timespec now;
    if (stat(folder, &found) != 0) {
        while (others_count)
            forget(others_count - 1);
        return;
    }
    const int64_t changed_ns = (int64_t)found.st_mtim.tv_sec * 1000000000 + found.st_mtim.tv_nsec;
    if (changed_ns == listed_ns)
        return;
    clock_gettime(CLOCK_REALTIME, &now);
    const int64_t now_ns = (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
    listed_ns = now_ns - changed_ns > 20000000 ? changed_ns : -1;
    list_folder();
    for (int n = others_count - 1; n >= 0; n--)
        if (!others[n].is_there)
            forget(n);
}

/* Into the folder; once more where the last of the others has just taken it away. */
static int join(const pkxyz_shared_settings *settings, char *why, int size)
{
    for (int attempt = 0;; attempt++) {
        if (folder_open(folder, settings->is_named, why, size) != 0)
            return -1;
        remove_socket(mine.sun_path); /* of a process that had our number and was killed */
        fchmod(descriptor, 0600);     /* before there is a name that somebody could open */
        if (bind(descriptor, (const struct sockaddr *)&mine, sizeof mine) == 0)
            return 0;
        if (errno != ENOENT || attempt == ATTEMPTS - 1) {
            snprintf(why, (size_t)size, "%s", strerror(errno));
            return -1;
        }
    }
}

static int open_bus(const pkxyz_shared_settings *settings, char *why, int size)
{
    const char *channel = (const char *)settings->channel;
    carries_fd = settings->fd;
    is_named = settings->is_named;
    mine.sun_family = AF_UNIX;
    const int length = snprintf(mine.sun_path, sizeof mine.sun_path, "%s/pkxyz-%d-1", channel, (int)getpid());
    if (length >= (int)sizeof mine.sun_path) {
        snprintf(why, (size_t)size, "the path of its folder is too long for a socket");
        return -1;
    }
    strcpy(folder, channel);
    descriptor = socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (descriptor < 0) {
        snprintf(why, (size_t)size, "%s", strerror(errno));
        return -1;
    }
    return join(settings, why, size);
}

static void pack(const frame *sent, datagram *to)
{
    const int64_t now_ns = clock_monotonic_ns();
    const uint32_t can_id = (uint32_t)sent->can_id | (sent->flags & FRAME_EXTENDED ? EXTENDED : 0) |
                            (sent->flags & FRAME_REMOTE ? REMOTE : 0) | (sent->flags & FRAME_ERROR ? ERROR_FRAME : 0);
    const int is_fd = sent->flags & FRAME_FD;
    memcpy(to->bytes, &now_ns, 8);
    memcpy(to->bytes + 8, &can_id, 4);
    to->bytes[12] = (uint8_t)sent->length;
    to->bytes[13] = (uint8_t)((is_fd ? FD_FRAME : 0) | (sent->flags & FRAME_FAST ? BIT_RATE_SWITCH : 0));
    const int carried = sent->flags & FRAME_REMOTE ? 0 : sent->length;
    memcpy(to->bytes + HEAD, sent->data, (size_t)carried);
    to->length = (uint8_t)(HEAD + carried);
}

/* 1: a frame. 0: not one of ours, since whoever can write into the folder can send anything; or one that a classic
   controller never sees. */
static int unpack(const uint8_t *bytes, long size, frame *taken)
{
    uint32_t can_id;
    if (size < HEAD)
        return 0;
    memcpy(&taken->sent_ns, bytes, 8);
    memcpy(&can_id, bytes + 8, 4);
    const int is_fd = bytes[13] & FD_FRAME, is_remote = (can_id & REMOTE) != 0;
    taken->length = bytes[12];
    if (taken->length > (is_fd ? FRAME_BYTES : 8) || (size - HEAD != taken->length && !is_remote) || (is_fd && !carries_fd))
        return 0;
    taken->can_id = (int32_t)(can_id & (can_id & EXTENDED ? 0x1fffffff : 0x7ff));
    taken->flags = (is_fd ? FRAME_FD : 0) | (bytes[13] & BIT_RATE_SWITCH ? FRAME_FAST : 0) |
                   (is_remote ? FRAME_REMOTE : 0) | (can_id & EXTENDED ? FRAME_EXTENDED : 0) |
                   (can_id & ERROR_FRAME ? FRAME_ERROR : 0);
    memset(taken->data, 0, sizeof taken->data);
    if (!is_remote)
        memcpy(taken->data, bytes + HEAD, (size_t)taken->length);
    return 1;
}

static int is_connected(participant *other)
{
    const struct sockaddr *address = (const struct sockaddr *)&other->address;
    if (other->descriptor < 0) {
        other->descriptor = socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
        if (other->descriptor >= 0 && connect(other->descriptor, address, sizeof other->address) != 0) {
            const int refusal = errno;
            disconnect(other);
            errno = refusal;
        }
    }
    return other->descriptor >= 0;
}

/* Sends to one other: 0; EAGAIN if its queue is full; ENOENT if it is gone, which is as good as sent; or an errno. */
static int reach(participant *other, const datagram *sent)
{
    const int was_connected = other->descriptor >= 0;
    if (is_connected(other) && send(other->descriptor, sent->bytes, sent->length, MSG_NOSIGNAL) >= 0)
        return 0;
    if (was_connected && errno != EAGAIN) { /* another may be there by now under the same name */
        disconnect(other);
        if (is_connected(other) && send(other->descriptor, sent->bytes, sent->length, MSG_NOSIGNAL) >= 0)
            return 0;
    }
    switch (errno) {
    case EAGAIN:
        return EAGAIN;
    case ECONNREFUSED:
    case ENOENT:
    case ECONNRESET:
    case ENOTCONN:
        return ENOENT;
    case EPROTOTYPE: /* something else with a name like that */
    case EACCES:
    case EPERM:
        return 0;
    default:
        return errno;
    }
}

static void forget_killed(int number)
{
    remove_socket(others[number].address.sun_path);
    forget(number);
}

/* What waits, as far as there is room for it, in its order. */
static void hand_over(void)
{
    for (int n = others_count - 1; n >= 0; n--) {
        participant *other = &others[n];
        while (other->waiting) {
            const int refusal = reach(other, &other->queue[other->first]);
            if (refusal == EAGAIN)
                break;
            if (refusal == ENOENT) {
                forget_killed(n);
                break;
            }
            other->first = (other->first + 1) % WAITING_MOST;
            other->waiting--;
            waiting_in_all--;
        }
    }
}

static int send_frame(const frame *sent)
{
    datagram packed;
    int failed = 0;
    if (sent->flags & FRAME_FD && !carries_fd)
        return EINVAL;
    pack(sent, &packed);
    if (waiting_in_all)
        hand_over();
    for (int n = others_count - 1; n >= 0; n--) {
        participant *other = &others[n];
        const int refusal = other->waiting ? EAGAIN : reach(other, &packed);
        if (refusal == EAGAIN && other->waiting < WAITING_MOST) {
            other->queue[(other->first + other->waiting++) % WAITING_MOST] = packed;
            waiting_in_all++;
        } else if (refusal == EAGAIN) {
            dropped++;
        } else if (refusal == ENOENT) {
            forget_killed(n);
        } else if (refusal != 0) {
            failed = refusal;
        }
    }
    return failed;
}

static int take(frame *taken)
{
    uint8_t bytes[DATAGRAM_MOST];
    if (waiting_in_all)
        hand_over();
    for (int n = 0; n < FOREIGN_MOST; n++) {
        const long size = recv(descriptor, bytes, sizeof bytes, 0);
        if (size < 0)
            return errno == EAGAIN || errno == EINTR ? 0 : -1;
        if (unpack(bytes, size, taken))
            return 1;
    }
    return 0;
}

static void discard(void)
{
    for (int n = 0; n < others_count; n++)
        others[n].waiting = others[n].first = 0;
    waiting_in_all = 0;
}

static int count_others(void)
{
    return others_count;
}

static int64_t count_dropped(void)
{
    return dropped;
}

static int64_t patience_us(void)
{
    return waiting_in_all ? RETRY_US : INT64_MAX / 2;
}

static int the_descriptor(void)
{
    return descriptor;
}

/* Leaves once what waits was handed over, or nobody takes it. */
static void close_bus(void)
{
    const struct timespec moment = {0, 1000000};
    for (int n = 0; n < LEAVE_MS && waiting_in_all; n++) {
        nanosleep(&moment, 0);
        hand_over();
    }
    while (others_count)
        forget(others_count - 1);
    close(descriptor);
    remove_socket(mine.sun_path);
    folder_close(folder, is_named);
}

const bus unix_bus = {open_bus, send_frame, take, look, discard, count_others, count_dropped, patience_us, the_descriptor,
                      close_bus};
