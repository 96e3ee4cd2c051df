"""The errors, named for who must act.

Every message is one line a person can act on: where, what was needed, what was found.
"""

import errno

# All that the name of a file can cause: too long, of another kind, taken, in no encoding.
_OF_A_NAME = frozenset(
    {
        errno.ENAMETOOLONG,
        errno.EEXIST,
        errno.ENOTDIR,
        errno.EISDIR,
        errno.EINVAL,
        errno.EILSEQ,
    }
)
# All that a file of somebody's own can cause besides: not there, a loop of links, kept closed.
_OF_A_FILE = _OF_A_NAME | {errno.ENOENT, errno.ELOOP, errno.EACCES, errno.EPERM}
_OF_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class PipelineError(Exception):
    """Anything cartlab cannot go on from; the command line prints its text and exits 2."""


class DataError(PipelineError):
    """The measured data do not support what was asked of them: look at the recording."""


class SubmissionError(PipelineError):
    """The submission's files are wrong or missing: look at `submission.toml` and `data/`."""


class ConfigError(PipelineError):
    """A rubric, preset, option or output folder is wrong: the person at the keyboard acts."""


class HardwareError(PipelineError):
    """The bench does not answer as it should: look at the cable, the port, the motor."""


def lies_in_the_name(error: OSError) -> bool:
    """Tell whether a file's name is to blame, and not the computer that was to write or read it.

    An error without a number is no complaint of the system, but a decoder's about what it reads.
    """
    return error.errno is None or error.errno in _OF_A_NAME


def lies_in_the_file(error: OSError) -> bool:
    """Tell whether a file, or its name, is to blame, and not the computer that was to read it."""
    return error.errno is None or error.errno in _OF_A_FILE


def lacks_room(error: OSError) -> bool:
    """Tell whether a file could not be written for lack of room on the disk."""
    return error.errno in _OF_ROOM
