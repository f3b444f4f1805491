"""Faults that stop, unless the user wants to go on."""

from dataclasses import dataclass, field

from render.shared.errors import InputError

ANYWAY = "--anyway goes on all the same"


@dataclass(frozen=True)
class Faults:
    """What becomes of a fault that leaves something to compute.

    Attributes:
        anyway: Go on.
        overridden: The faults so far, in plain sentences.
    """

    anyway: bool = False
    overridden: list[str] = field(default_factory=list)

    def stop(self, text: str) -> None:
        """Stop, or keep the text and go on.

        Raises:
            InputError: nobody said to go on.
        """
        if not self.anyway:
            raise InputError(f"{text} ({ANYWAY})")
        self.overridden.append(text)
