"""A GigE Vision device of our own: one process a device, answering real Aravis over UDP.

It does what the fake device of Aravis cannot: packet resend, action commands with an answer and a
set time, clocks that follow a master, chunk data, frame numbers of 64 bits, every fault on request.
`running.RunningDevice` starts one; `setup.Setup` says what it is; `pixels` what its images hold.

References:
    Register addresses and packet layouts: the public headers of Aravis (``arvgvcpprivate.h``,
    ``arvgvspprivate.h``) and the GVCP and GVSP dissectors of Wireshark.
"""
