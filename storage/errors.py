"""The exception tree. Every message says what is wrong, where, what was found, what is allowed and what to do."""


class T6GpsError(Exception):
    """Base of every error that a user of this package can cause or repair; the command line exits with 2."""


class ConfigError(T6GpsError):
    """A preset, a configuration file or an override that cannot be used."""


class RunError(T6GpsError):
    """A run that does not exist, cannot be created, or cannot be continued."""


class LearnerDiedError(RunError):
    """The learner's process ended; another one can resume from the newest checkpoint and the spool."""


class DataError(T6GpsError):
    """A table that does not follow its schema: wrong column, type, length, null, or a non-finite number."""


class CheckpointError(T6GpsError):
    """A checkpoint that is missing, torn or altered."""


class QueryError(T6GpsError):
    """SQL that was refused, failed, or exceeded its limits."""


class ServerError(T6GpsError):
    """A server that cannot be started or reached, or that refuses who asks: token, scope, origin, size, rate."""


class StoreError(T6GpsError):
    """An object store that refuses what is asked of it: keys, bucket, address, what may be written."""


class StoreUnreachableError(StoreError):
    """An object store that does not answer, and may later."""


class TerrainError(T6GpsError):
    """A terrain that cannot be built or stood on."""


class PhysicsError(T6GpsError):
    """A simulator that cannot be started or used."""


class UnsoundStateError(PhysicsError):
    """A simulation that left the range of sound states; `reason` names it, the same for all that end alike."""

    def __init__(self, message: str, reason: str) -> None:
        super().__init__(message, reason)
        self.reason = reason

    def __str__(self) -> str:
        return str(self.args[0])
