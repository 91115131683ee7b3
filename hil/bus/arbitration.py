"""Who wins the arbitration: the order of frames that start at the same time, and the queue that follows it."""

from heapq import heapify, heappop

from pkxyz_ctrl.can.frame import Frame

Entry = tuple[int, int, Frame, int]  # arbitration key, order of queueing, frame, duration_ns


def arbitration_key(frame: Frame) -> int:
    """The bits that arbitrate, as one number: the smaller wins. Base identifier, RTR or SRR, IDE, extension, RTR."""
    if not frame.is_extended:
        return frame.can_id << 21 | frame.is_remote << 20
    return (frame.can_id >> 18) << 21 | 3 << 19 | (frame.can_id & 0x3FFFF) << 1 | frame.is_remote


def dominance(frame: Frame) -> tuple[bool, int, bytes]:
    """Order of frames with equal arbitration bits: the first bit where they differ decides (FDF, DLC, data)."""
    return frame.is_fd, len(frame.data), frame.data


def unqueue(to_send: list[Entry], entry: Entry) -> None:
    """Take ``entry`` out of a heap that holds it; as a rule it is the first."""
    if to_send[0] is entry:
        heappop(to_send)
    else:
        to_send.remove(entry)
        heapify(to_send)
