"""What the supervisor observes, and what it instructs: plain data that can be written down and read again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from t6gps.service.pool.attempt import Failure
from t6gps.service.pool.state import Ending, Identity, RunState, WorkerId
from t6gps.storage.records import EpisodePlan


@dataclass(frozen=True)
class Opened:
    """A batch of plans begins.

    quarantined      episodes that are not tried
    policy_digests   by version
    worked           an episode of the run was durable before
    """

    plans: tuple[EpisodePlan, ...]
    quarantined: tuple[int, ...]
    policy_digests: Mapping[int, str]
    worked: bool


@dataclass(frozen=True)
class Ready:
    """A worker has started."""

    worker: WorkerId
    identity: Identity


@dataclass(frozen=True)
class Alive:
    """An idle worker has answered."""

    worker: WorkerId


@dataclass(frozen=True)
class Sampled:
    """An episode came back, at that time."""

    worker: WorkerId
    plan: EpisodePlan
    nbytes: int
    policy_digest: str
    at_s: float


@dataclass(frozen=True)
class Failed:
    """An attempt at an episode failed in the worker, at that time."""

    worker: WorkerId
    plan: EpisodePlan
    failure: Failure
    policy_digest: str
    at_s: float


@dataclass(frozen=True)
class Unserved:
    """A worker could not get the policy that a plan names, at that time."""

    worker: WorkerId
    plan: EpisodePlan
    at_s: float


@dataclass(frozen=True)
class Died:
    """A worker's process has ended, or could not begin."""

    worker: WorkerId
    error: str
    message: str


@dataclass(frozen=True)
class PostMortem:
    """What could be learned of a worker from outside before it was killed.

    episode_at_fault   False when somebody else ended or stopped the worker, or its node is gone
    """

    stacks: str = ""
    log: str = ""
    episode_at_fault: bool = True


@dataclass(frozen=True)
class Ended:
    """A worker was ended as instructed."""

    worker: WorkerId
    post_mortem: PostMortem


@dataclass(frozen=True)
class Durable:
    """An episode that came back is durable."""

    episode_id: int


@dataclass(frozen=True)
class Capacity:
    """There is room for `free_n` more workers; those of `waiting` have found none."""

    free_n: int
    waiting: tuple[WorkerId, ...]


@dataclass(frozen=True)
class ScaleRequested:
    """Somebody asks for another number of workers; none is a pause."""

    workers: int


@dataclass(frozen=True)
class UnpauseRequested:
    """Somebody asks for what there was before the pause."""


@dataclass(frozen=True)
class Paused:
    """The supervisor itself has not looked for a while."""


Observation = (
    Opened
    | Ready
    | Alive
    | Sampled
    | Failed
    | Unserved
    | Died
    | Ended
    | Durable
    | Capacity
    | ScaleRequested
    | UnpauseRequested
    | Paused
)


@dataclass(frozen=True)
class Start:
    """Start a worker; a `Ready` or a `Died` follows."""

    worker: WorkerId


@dataclass(frozen=True)
class Send:
    """Give a worker a plan; a `Sampled`, `Failed`, `Unserved` or `Died` follows."""

    worker: WorkerId
    plan: EpisodePlan


@dataclass(frozen=True)
class Ping:
    """Ask an idle worker for a sign of life; an `Alive` or a `Died` follows."""

    worker: WorkerId


@dataclass(frozen=True)
class End:
    """Look at a worker and end it at once, whatever it does; an `Ended` follows."""

    worker: WorkerId
    why: Ending


@dataclass(frozen=True)
class AskCapacity:
    """Ask the cluster for room, and whether these workers have found some; a `Capacity` follows."""

    starting: tuple[WorkerId, ...]


@dataclass(frozen=True)
class AskNodes:
    """Let the cluster have room for so many workers, where it can grow; none is the end of that."""

    workers: int


@dataclass(frozen=True)
class Accept:
    """Hand an episode that came back to the run; a `Durable` follows. Others that came back are dropped."""

    worker: WorkerId
    episode_id: int


@dataclass(frozen=True)
class Quarantine:
    """Keep what is needed to find out why an episode fails."""

    plan: EpisodePlan


@dataclass(frozen=True)
class Publish:
    """Tell how the run is."""

    condition: RunState
    reason: str


Instruction = Start | Send | Ping | End | AskCapacity | AskNodes | Accept | Quarantine | Publish
