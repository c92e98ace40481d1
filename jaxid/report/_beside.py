"""The first and the last model compared with the recordings that the page shows."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..discovery import Comparison, Discovery, compare
from ..discovery.step import Step


@dataclasses.dataclass(frozen=True)
class Beside:
    """The starting and the final model compared with recordings, held-out ones if available.

    - `unseen`: whether the recordings were used in no fit.
    """

    story: Discovery
    unseen: bool
    before: Comparison
    after: Comparison

    @staticmethod
    def of(story: Discovery) -> "Beside":
        """The models of a story; comparisons that the story does not contain are simulated."""
        first, last = story.steps[0], story.steps[-1]
        unseen = all(step.held_out is not None for step in story.steps)
        before = _compared(first, unseen)
        after = before if first is last else _compared(last, unseen)
        return Beside(story, unseen, before, after)

    @property
    def several(self) -> bool:
        """Whether the starting and the final model differ."""
        return self.before is not self.after

    @property
    def error(self) -> Float[np.ndarray, "recordings joints"]:
        """Relative error of the final model, %."""
        return self.after.error_percent.to_numpy()

    @property
    def floor(self) -> Float[np.ndarray, "recordings joints"]:
        """Relative error due to noise alone, %, as estimated on the fitted recordings."""
        story = self.story
        if not self.unseen:
            return story.diagnosis.floor_by_recording()
        return np.broadcast_to(story.noise_floor_percent(), self.error.shape)

    def noise(self, recording: int) -> Float[np.ndarray, " joints"]:
        """Standard deviation of each joint's noise, in the unit of the signal."""
        measured = self.after.judged(recording)[1]
        return self.floor[recording] / 100 * np.sqrt(np.mean(measured**2, axis=0))

    @property
    def ratio(self) -> Float[np.ndarray, "recordings joints"]:
        """Error of the final model over the noise floor."""
        return self.error / np.maximum(self.floor, 1e-12)

    @property
    def worst(self) -> int:
        """The recording with the largest ratio of the final model's error to the noise floor."""
        return int(np.argmax(np.max(self.ratio, axis=1)))

    @property
    def lead(self) -> int:
        """Index of the joint whose error fell most; for a single model, the joint it fits worst."""
        k = self.worst
        if not self.several:
            return int(np.argmax(self.ratio[k]))
        gain = self.before.error_percent.to_numpy()[k] / np.maximum(self.error[k], 1e-12)
        return int(np.argmax(gain))


def _compared(step: Step, unseen: bool) -> Comparison:
    if unseen and step.held_out is not None:
        return step.held_out
    return compare(step.fit, step.fit.recordings)
