"""Stages with state as the engine calls them: each with the state of one run."""

from typing import Any


class Running:
    """A stage together with the state of one run."""

    def __init__(self, stage: Any) -> None:
        self.stage, self.state = stage, stage.start()

    def __call__(self, *inputs: Any, **named: Any) -> Any:
        return self.stage(*inputs, **named, state=self.state)

    def __getattr__(self, name: str) -> Any:
        """The stage's parameters."""
        return getattr(self.stage, name)

    def finding(self) -> Any:
        return self.stage.finding(self.state)
