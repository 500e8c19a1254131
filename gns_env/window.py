"""A window for render_mode="human", by pygame as in Gymnasium's own envs."""

from __future__ import annotations

import logging
import os
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray


def require_pygame() -> Any:
    """The module.

    Raises:
        DependencyNotInstalled: with the command that installs it.
    """
    try:
        import pygame
    except ImportError:
        raise DependencyNotInstalled(
            'human rendering needs pygame: pip install "gns-baffles[rl]"'
        ) from None
    return pygame


class Window:
    """Shows images, at most `fps` a second. Without a display it draws to nowhere, and says so."""

    def __init__(self, title: str, fps: float) -> None:
        self._pygame, self._title, self._fps = require_pygame(), title, fps
        self._surface: Any = None
        self._clock: Any = None

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show an RGB image, shape (H, W, 3)."""
        pygame, size = self._pygame, (image.shape[1], image.shape[0])
        if self._surface is None or self._surface.get_size() != size:
            self._surface = self._open(size)
            pygame.display.set_caption(self._title)
            self._clock = pygame.time.Clock()
        pygame.surfarray.blit_array(self._surface, image.swapaxes(0, 1))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None

    def _open(self, size: tuple[int, int]) -> Any:
        pygame = self._pygame
        try:
            pygame.display.init()
            return pygame.display.set_mode(size)
        except pygame.error as error:
            logging.getLogger("gns_env").warning(
                "no display for human rendering (%s): drawing to nowhere", error
            )
            pygame.display.quit()
            os.environ["SDL_VIDEODRIVER"] = "dummy"
            pygame.display.init()
            return pygame.display.set_mode(size)
