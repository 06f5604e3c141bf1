"""What one iteration leaves to the next, and its checkpoint; the names of the arrays are those on disk."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from t6gps.learner.algorithm import pairs
from t6gps.learner.algorithm.pairs import Pairs
from t6gps.learner.improvers.action_value import ActionValue
from t6gps.learner.port import Arrays, LearnerState, Manifest, packed_policy
from t6gps.learner.rows import AnyArray
from t6gps.storage.errors import CheckpointError, RunError
from t6gps.storage.records import PolicySnapshot


class Carried:
    """Policies and replayed pairs, which outlive an iteration.

    snapshot        the newest policy
    replayed        pairs of the iterations before, oldest first
    keeps_earlier   the policy before the newest is kept, too
    """

    def __init__(self, untrained: PolicySnapshot, replay_iterations: int, keeps_earlier: bool) -> None:
        self.snapshot = untrained
        self.replayed: deque[Pairs] = deque(maxlen=replay_iterations)
        self._earlier: PolicySnapshot | None = None
        self._keeps_earlier = keeps_earlier

    def policy(self, version: int | None) -> PolicySnapshot:
        """The policy of a version, the newest for None. Raises RunError when it is not kept."""
        for kept in (self.snapshot, self._earlier):
            if kept is not None and version in (None, kept.version):
                return kept
        raise RunError(
            f"policy version {version} is not kept, the learner has come to version {self.snapshot.version}; "
            "only run.pipelined keeps the one before"
        )

    def advance(self, newest: PolicySnapshot, learned: Pairs) -> None:
        """An iteration is over: its policy, and the pairs that made it."""
        self._earlier, self.snapshot = self.snapshot if self._keeps_earlier else None, newest
        self.replayed.append(learned)

    def pack(self, value: ActionValue | None) -> LearnerState:
        """A checkpoint of all that the next iteration depends on, but for what a run's tables hold."""
        newest, arrays = self.snapshot, _arrays(self.snapshot, "layer")
        if self._earlier is not None:
            arrays |= _arrays(self._earlier, "earlier_layer")
        for number, replay in enumerate(self.replayed):
            arrays[f"replay_{number}_observations"] = replay.observation[replay.rows]
            arrays[f"replay_{number}_actions"] = replay.action[replay.rows]
        if value is not None:
            arrays |= value.arrays()
        manifest: Manifest = {
            "version": newest.version,
            "offset_m": newest.offset_m,
            "scale_m": newest.scale_m,
            "layers": len(newest.layers),
            "replays": len(self.replayed),
        }
        return LearnerState(manifest, arrays)

    def unpack(self, manifest: Manifest, arrays: Mapping[str, AnyArray], value: ActionValue | None) -> None:
        """Continue from `pack`, as does the action value.

        Raises CheckpointError when entries are missing or the network has another shape than the present one.
        """
        try:
            restored, earlier = packed_policy(manifest, arrays), None
            if self._keeps_earlier and restored.version > 0:
                earlier = packed_policy(manifest, arrays, "earlier_layer", restored.version - 1)
            replayed = [
                pairs.every(arrays[f"replay_{number}_observations"], arrays[f"replay_{number}_actions"])
                for number in range(manifest["replays"])
            ]
            if value is not None:
                value.restore(arrays)
        except KeyError as error:
            raise CheckpointError(f"the learner's checkpoint lacks {error}; use an older checkpoint") from error
        shapes, expected = ([weight.shape for weight, _ in policy.layers] for policy in (restored, self.snapshot))
        if shapes != expected:
            raise CheckpointError(
                f"the checkpoint's policy has layers {shapes}, the settings ask for {expected}; "
                "set hidden_layers as in the run that wrote it"
            )
        self.snapshot, self._earlier = restored, earlier
        self.replayed = deque(replayed, maxlen=self.replayed.maxlen)


def _arrays(snapshot: PolicySnapshot, name: str) -> Arrays:
    """The layers of a policy under the names that a checkpoint has for them."""
    arrays: Arrays = {}
    for number, (weight, bias) in enumerate(snapshot.layers):
        arrays[f"{name}_{number}_weight"], arrays[f"{name}_{number}_bias"] = weight, bias
    return arrays
