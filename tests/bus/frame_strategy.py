"""Frames for hypothesis: every format and length, contents that need many stuff bits."""

from hypothesis import strategies as st

from bus.frames import CAN_FD_LENGTHS, Frame


def contents(length: int) -> st.SearchStrategy[bytes]:
    """Random content mixed with runs of equal bits, which is what stuffing is about."""
    runs = st.sampled_from([b"\x00", b"\xff", b"\x0f", b"\x1f", b"\x07", b"\xf8", b"\xe1"])
    piece = st.one_of(runs, st.binary(min_size=1, max_size=1))
    return st.lists(piece, min_size=length, max_size=length).map(b"".join)


def identifiers(extended: bool) -> st.SearchStrategy[int]:
    top = 2**29 - 1 if extended else 2**11 - 1
    return st.one_of(st.integers(0, top), st.sampled_from([0, top, 0x180, 0x200, 0x0F8]))


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    extended = draw(st.booleans())
    fd = draw(st.booleans())
    length = draw(st.sampled_from(CAN_FD_LENGTHS if fd else range(9)))
    brs, esi = fd and draw(st.booleans()), fd and draw(st.booleans())
    remote = not fd and draw(st.booleans())
    data = bytes(length) if remote else draw(contents(length))
    return Frame(draw(identifiers(extended)), data, fd, brs, extended, remote, esi)
