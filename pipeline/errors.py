"""The error classes; each says where to look for the fault.

Every message is one line that says where the fault is, what was expected and what was found.
"""

import errno

# File errors caused by a name: too long, already taken, not encodable, the wrong kind of file.
_NAME_FAULTS = frozenset(
    {
        errno.ENAMETOOLONG,
        errno.EEXIST,
        errno.ENOTDIR,
        errno.EISDIR,
        errno.EINVAL,
        errno.EILSEQ,
    }
)
# These errors, and others of a user's file: it is missing, in a loop of links, or not permitted.
_FILE_FAULTS = _NAME_FAULTS | {errno.ENOENT, errno.ELOOP, errno.EACCES, errno.EPERM}
_DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class PipelineError(Exception):
    """An error that stops cartlab; the command line prints its text and exits with status 2."""


class DataError(PipelineError):
    """The measured data cannot give the wanted result: look at the recording."""


class SubmissionError(PipelineError):
    """The submission's files are wrong or missing: look at `submission.toml` and `data/`."""


class ConfigError(PipelineError):
    """A rubric, preset, option or output folder is wrong: the person who runs cartlab must act."""


class HardwareError(PipelineError):
    """The bench does not answer as it should: look at the cable, the port, the motor."""


def is_name_fault(error: OSError) -> bool:
    """Return whether the file's name caused the error, rather than the computer.

    An error without an `errno` comes from a text decoder, so the file is at fault too.
    """
    return error.errno is None or error.errno in _NAME_FAULTS


def is_file_fault(error: OSError) -> bool:
    """Return whether the file or its name caused the error, rather than the computer."""
    return error.errno is None or error.errno in _FILE_FAULTS


def is_disk_full(error: OSError) -> bool:
    """Return whether a file could not be written because the disk is full."""
    return error.errno in _DISK_FULL
