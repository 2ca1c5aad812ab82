"""The errors that a user meets, each with the exit status of the command that ends with it."""


class MpitledError(Exception):
    """An end with a reason: one line to the user, no traceback."""

    status = 1
    everywhere = False  # whether every rank raises it alike, so that one message is enough and none need be aborted


class InputError(MpitledError):
    """Bad input: names the file, the line or key, and the remedy."""

    status = 2


class UnstableError(MpitledError):
    """The computation cannot go on: names the cell, the place and what to change."""

    status = 3


class InterruptedRun(MpitledError):
    """Ended from outside (Ctrl-C, SIGTERM); what was written is readable, and the run can go on from there."""

    status = 4
