"""How scenes are rendered while a network trains: the `stream` section of a preset."""

from dataclasses import dataclass

from render.shared.config import check_fields
from render.shared.errors import InputError


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """How scenes are rendered while a network trains.

    Attributes:
        window: Scenes kept in memory, from which batches are drawn; no more than the plan has.
        fresh: New scenes per batch, above 0; may be below 1.
        depth: Finished scenes kept ready in addition to the window; changes only how long training waits.
        threads: Threads that render; 0 takes half of the cores and leaves the rest to the trainer.
        recycle: Scenes after which the process is replaced, since Mitsuba keeps some memory of every scene.
        timeout: Seconds to wait for a scene before giving up; 0 waits for ever.
    """

    window: int = 128
    fresh: float = 1.0
    depth: int = 4
    threads: int = 0
    recycle: int = 500
    timeout: float = 600.0

    def __post_init__(self) -> None:
        check_fields(self, "positive", "window", "fresh", "depth", "recycle", section="stream")
        check_fields(self, "not negative", "threads", "timeout", section="stream")
        if self.fresh > self.window:
            raise InputError(f"stream.fresh {self.fresh} must not exceed stream.window {self.window}")
