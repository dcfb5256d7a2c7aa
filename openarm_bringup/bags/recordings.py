# SPDX-License-Identifier: Apache-2.0
"""The folder of flight recordings of a run: numbered bags, of which the oldest give way."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Mapping
from pathlib import Path

from openarm_bringup.bags.bag import BagWriter, check_room
from openarm_bringup.bags.ring import Moment
from openarm_bringup.supervision.runs import recording_number, recordings
from openarm_common.errors import Code, OpenArmError


class Recordings:
    """Writes recordings into a folder, which is made for the first.

    Args:
        folder: Folder of this run.
        most: Number of recordings that are kept.
        limit: Bytes of all of them; the newest is kept in any case.
    """

    def __init__(self, folder: Path, most: int, limit: int) -> None:
        self._folder, self._most, self._limit = folder, most, limit
        self._lock = threading.Lock()
        self._last = 0

    def reserve(self, code: str) -> Path:
        """Return the path of the next recording, which exists once it has been written.

        Args:
            code: Why there is one, such as GRASP_LOST.

        Raises:
            OpenArmError: ENVIRONMENT, when the folder can't be made or the disk is almost full.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            check_room(self._folder)
        except OSError as error:
            raise OpenArmError(Code.ENVIRONMENT, f"nothing is recorded in {self._folder}: {error}") from error
        self._last = max([self._last, *map(recording_number, recordings(self._folder))]) + 1
        return self._folder / f"{self._last:02d}_{code}"

    def write(self, path: Path, moment: Moment, custom: Mapping[str, str]) -> None:
        """Write what a ring held; other paths than complete ones never appear. Then let the oldest give way.

        Args:
            path: Path from `reserve`.
            moment: The messages.
            custom: Kept in the metadata.

        Raises:
            OpenArmError: ENVIRONMENT, when it can't be written; nothing of it is left.
        """
        with self._lock:
            draft = self._folder / f".unfinished-{os.getpid()}" / path.name
            try:
                with BagWriter(draft, custom) as bag:
                    for topic in moment.topics:
                        bag.add_topic(*topic)
                    for message in moment.messages():
                        bag.write(*message)
                draft.rename(path)
            except OSError as error:
                raise OpenArmError(Code.ENVIRONMENT, f"{path} can't be written: {error}") from error
            finally:
                shutil.rmtree(draft.parent, ignore_errors=True)
            self._make_room()

    def _make_room(self) -> None:
        found = recordings(self._folder)
        sizes = {path: sum(file.stat().st_size for file in path.glob("*")) for path in found}
        while len(found) > 1 and (len(found) > self._most or sum(sizes[path] for path in found) > self._limit):
            shutil.rmtree(found.pop(0), ignore_errors=True)
