"""Errors that a user can act on; all are a `DrakerockError`."""


class DrakerockError(Exception):
    """Root of the package's errors."""


class InputError(DrakerockError):
    """Bad input: a YAML key, an SDFormat file, a data file, an option, a folder.

    The message names the file, the line, the key, and what is allowed. The command line prints it alone
    and exits with code 2.
    """


class SimulationFailure(DrakerockError):
    """The dynamics could not go on (solver failure, a state that is not finite).

    A cycle that raises it is recorded as failed with this message; a campaign goes on.
    """


class RunStopped(DrakerockError):
    """A campaign had to stop: full disk, lost scheduler, workers that cannot work.

    What was finished is stored; the same command goes on once the cause is removed.
    """
