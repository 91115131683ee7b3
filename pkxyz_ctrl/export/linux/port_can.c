/* The kernel's CAN sockets: one raw socket, classic or FD, with the kernel's stamp on each frame. */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "clock.h"
#include "port.h"

enum { ROOM_BYTES = 1 << 20 }; /* for frames that wait to be read; the kernel's own default held 278 of them */
static const int64_t STAMP_MAX_AGE_NS = 1000000000;

static int descriptor = -1, carries_fd;

static int refuse(char *why, int size)
{
    snprintf(why, (size_t)size, "%s", strerror(errno));
    if (descriptor >= 0)
        close(descriptor);
    descriptor = -1;
    return -1;
}

/* Whether the interface itself carries FD frames (ip link set ... mtu 72). */
static int takes_fd(const char *name)
{
    struct ifreq asked = {0};
    snprintf(asked.ifr_name, sizeof asked.ifr_name, "%.15s", name);
    return ioctl(descriptor, SIOCGIFMTU, &asked) == 0 && asked.ifr_mtu >= (int)CANFD_MTU;
}

static int open_bus(const pkxyz_shared_settings *settings, char *why, int size)
{
    const char *name = (const char *)settings->channel;
    const int on = 1, room = ROOM_BYTES;
    const can_err_mask_t errors = CAN_ERR_MASK;
    carries_fd = settings->fd;
    descriptor = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW);
    if (descriptor < 0)
        return refuse(why, size);
    const struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(name)};
    if (address.can_ifindex == 0)
        return refuse(why, size);
    if (carries_fd && !takes_fd(name)) {
        errno = EINVAL;
        refuse(why, size);
        snprintf(why, (size_t)size, "it carries no FD frames: set it up for them (ip link set %s mtu 72, type can ... fd on), "
                                    "or say fd = false", name);
        return -1;
    }
    if (carries_fd && setsockopt(descriptor, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on) != 0)
        return refuse(why, size);
    setsockopt(descriptor, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &errors, sizeof errors);
    setsockopt(descriptor, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on);
    setsockopt(descriptor, SOL_SOCKET, SO_RCVBUF, &room, sizeof room);
    if (bind(descriptor, (const struct sockaddr *)&address, sizeof address) != 0)
        return refuse(why, size);
    return 0;
}

static int send_frame(const frame *sent)
{
    struct canfd_frame out = {.len = (uint8_t)sent->length};
    const int is_fd = sent->flags & FRAME_FD;
    out.can_id = (canid_t)sent->can_id | (sent->flags & FRAME_EXTENDED ? CAN_EFF_FLAG : 0) |
                 (sent->flags & FRAME_REMOTE ? CAN_RTR_FLAG : 0);
    out.flags = is_fd && sent->flags & FRAME_FAST ? CANFD_BRS : 0;
    memcpy(out.data, sent->data, (size_t)sent->length);
    return write(descriptor, &out, is_fd ? CANFD_MTU : CAN_MTU) >= 0 ? 0 : errno;
}

static int64_t ns_of(const struct timespec *time)
{
    return (int64_t)time->tv_sec * 1000000000 + time->tv_nsec;
}

/* On CLOCK_MONOTONIC, from the kernel's stamp, which is a time of day. A stamp of the future, or an old one, is none. */
static int64_t sent_ns(struct msghdr *message)
{
    struct timespec stamp, today;
    const int64_t now_ns = clock_monotonic_ns();
    clock_gettime(CLOCK_REALTIME, &today);
    for (struct cmsghdr *said = CMSG_FIRSTHDR(message); said; said = CMSG_NXTHDR(message, said))
        if (said->cmsg_level == SOL_SOCKET && said->cmsg_type == SCM_TIMESTAMPNS) {
            memcpy(&stamp, CMSG_DATA(said), sizeof stamp);
            const int64_t age_ns = ns_of(&today) - ns_of(&stamp);
            if (age_ns >= 0 && age_ns < STAMP_MAX_AGE_NS)
                return now_ns - age_ns;
        }
    return now_ns;
}

static int take(frame *taken)
{
    struct canfd_frame in;
    _Alignas(struct cmsghdr) char said[128];
    struct iovec place = {&in, sizeof in};
    struct msghdr message = {.msg_iov = &place, .msg_iovlen = 1, .msg_control = said, .msg_controllen = sizeof said};
    const long size = recvmsg(descriptor, &message, 0);
    if (size < 0)
        return errno == EAGAIN || errno == EINTR ? 0 : -1;
    if (size != CAN_MTU && size != CANFD_MTU)
        return 0;
    const int is_fd = size == CANFD_MTU;
    taken->sent_ns = sent_ns(&message);
    taken->can_id = (int32_t)(in.can_id & (in.can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG) ? CAN_EFF_MASK : CAN_SFF_MASK));
    taken->flags = (is_fd ? FRAME_FD : 0) | (is_fd && in.flags & CANFD_BRS ? FRAME_FAST : 0) |
                   (in.can_id & CAN_RTR_FLAG ? FRAME_REMOTE : 0) | (in.can_id & CAN_EFF_FLAG ? FRAME_EXTENDED : 0) |
                   (in.can_id & CAN_ERR_FLAG ? FRAME_ERROR : 0);
    taken->length = in.len > (is_fd ? FRAME_BYTES : 8) ? 0 : in.len;
    memset(taken->data, 0, sizeof taken->data);
    if (!(in.can_id & CAN_RTR_FLAG))
        memcpy(taken->data, in.data, (size_t)taken->length);
    return 1;
}

static void nothing(void)
{
}

static int not_known(void)
{
    return -1;
}

static int64_t none(void)
{
    return 0;
}

static int64_t patience_us(void)
{
    return INT64_MAX / 2;
}

static int the_descriptor(void)
{
    return descriptor;
}

static void close_bus(void)
{
    close(descriptor);
}

/* The kernel's sockets have no way to take back what they were given. */
const bus can_bus = {open_bus, send_frame, take, nothing, nothing, not_known, none, patience_us, the_descriptor, close_bus};
