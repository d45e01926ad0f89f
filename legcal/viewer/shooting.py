"""The dialogue of ``legcal shoot``: what is asked, what is answered; in a terminal or on a page."""

from __future__ import annotations

import queue
from collections.abc import Callable
from pathlib import Path
from typing import Any

from legcal.calibration.summary import mm_deg
from legcal.errors import LegcalError, printable
from legcal.pages.document import Dialogue as DialogueBlock
from legcal.pages.document import Page, Section, page_html
from legcal.planning.session import settings_in_words
from legcal.planning.shooting import Asked, Checked, GuidedSession
from legcal.recordings.frames import LiveCamera, WatchedFolder
from legcal.viewer.server import HTML, LOCAL, Address, PageServer

WORDS = "keep (take the refused one), skip (leave the pose out), undo (take the last one out), quit"
PAUSE = 0.5  # between two looks for photographs [s]
_UNKNOWN = 0.02  # errors above are not known yet, of the mean leg length


class Dialogue:
    """Takes photographs and words until a session is complete or its owner quits.

    Words are those of :data:`WORDS`, and nothing, which asks a camera for a photograph.
    """

    def __init__(
        self,
        session: GuidedSession,
        source: WatchedFolder | LiveCamera,
        say: Callable[[str], None],
    ) -> None:
        self.session, self.source = session, source
        self.words = queue.SimpleQueue[str]()
        self.lines: list[str] = []  # what was said
        self._say = say
        self._refused: tuple[Path, Checked] | None = None
        self._before: set[str] = set()  # incomplete files of the last look
        self._told: set[str] = set()  # of these, those that were named
        self.asked: Asked | None = None
        self._shown: dict[str, Any] = {"prompt": [], "known": "", "taken": 0, "of": 1}

    def say(self, text: str) -> None:
        """Show a sentence in the terminal and on the page."""
        self.lines.append(printable(text))
        self._say(printable(text))

    def run(self) -> bool:
        """Go on until the session is complete; return whether it is."""
        self._ask()
        while self.asked is not None:
            try:
                word = self.words.get(timeout=PAUSE)
            except queue.Empty:
                word = None
            try:
                if word is not None and word.strip() == "quit":
                    self.say("The session is left here; the same command goes on.")
                    return False
                if word is not None and word.strip():
                    self._hear(word.strip(), self.asked)
                photograph = self.source.poll(wanted=word is not None and not word.strip())
                if photograph is not None and self.asked is not None:
                    self._look(self.asked, photograph)
            except LegcalError as error:
                self.say(str(error))
            self._tell_waiting()
        complete = self.session.is_complete
        self.say(
            f"The session is complete. {self.known}"
            if complete
            else f"The plan is done, and no further pose can be named here. {self.known}"
        )
        return complete

    def _ask(self) -> None:
        self.asked, self._refused = self.session.next(), None
        prompt = [] if self.asked is None else self._prompt(self.asked)
        self._shown = {
            "prompt": prompt,
            "known": self.known,
            "taken": len(self.session.taken),
            "of": self.session.n_planned,
        }
        for line in prompt:
            self.say(line)

    def _prompt(self, asked: Asked) -> list[str]:
        n, of = len(self.session.taken), self.session.n_planned
        number = f"{n + 1} of {of}" if asked.is_planned else f"{n + 1}, beyond the plan"
        settings = ", ".join(settings_in_words(self.session.machine, asked.q))
        how = {"": "", "home": "by home: "}.get(asked.via, f"by {asked.via}: ")
        return [
            f"Photograph {number}: camera at {asked.view}, pose {asked.pose}.",
            f"  set {how}{settings}; then {self.source.asks}.",
        ]

    def _hear(self, word: str, asked: Asked) -> None:
        if word == "keep" and self._refused is not None:
            self._take(asked, *self._refused)
        elif word == "skip":
            self.session.skipped.add((asked.view, asked.pose))
            self._ask()
        elif word == "undo":
            image = self.session.undo()
            self.say(f"{image} was taken out." if image else "There is no photograph to take out.")
            self._ask()
        else:
            self.say(f"'{word}' is not understood. Words are: {WORDS}.")

    def _look(self, asked: Asked, photograph: Path) -> None:
        checked = self.session.check(asked, photograph)
        if checked.problems:
            if checked.exposure is not None:
                self._refused = (photograph, checked)
            for problem in checked.problems:
                self.say(f"  {photograph.name} was not taken: {problem}")
            return
        self._take(asked, photograph, checked)

    def _take(self, asked: Asked, photograph: Path, checked: Checked) -> None:
        self._refused = photograph, checked  # until it is taken
        self.session.accept(asked, photograph, checked=checked)
        legs = "" if checked.legs is None else f", {checked.legs.sum()} of {checked.n_visible} legs"
        blur = "" if checked.exposure is None else f", blur {checked.exposure.blur:.1f} px"
        self.say(f"  {photograph.name} is {asked.view} {asked.pose}{blur}{legs}. {self.known}")
        for note in (*checked.notes, *self.session.notes):
            self.say(f"  note: {note}")
        self.session.notes.clear()
        self._ask()

    def _tell_waiting(self) -> None:
        if new := sorted((self.source.incomplete & self._before) - self._told):
            self.say(f"  waiting for the rest of {', '.join(new)}")
        self._told.update(new)
        self._before = set(self.source.incomplete)

    @property
    def known(self) -> str:
        """What the photographs so far determine, in words."""
        error, session = self.session.error, self.session
        if error is None:
            return ""
        if error.mean_displacement > _UNKNOWN * session.machine.size:
            return "The platform is not determined yet."
        target = "" if session.target is None else f" (target {1e3 * session.target:g} mm)"
        return (
            f"Predicted error {mm_deg(error.mean_displacement, error.mean_rotation)} (1 sigma)"
            f"{target}."
        )

    def state(self) -> dict[str, Any]:
        """Return what the page shows."""
        return {**self._shown, "lines": self.lines[-12:]}


class DialogueServer(PageServer):
    """The page of a dialogue, which shows what is asked and takes the same words."""

    def __init__(self, dialogue: Dialogue, port: int = 0) -> None:
        super().__init__(Address(LOCAL, port))
        self.dialogue = dialogue
        folder = str(dialogue.session.folder)
        blocks = [DialogueBlock(self.token)]
        self._page = page_html(Page("Session", folder, None, [Section("next", "Next", blocks)]))

    def content(self, path: str) -> tuple[str, bytes] | None:
        """Return the page; None for other paths."""
        return (HTML, self._page.encode()) if path == "/" else None

    def answer(self, path: str, query: dict[str, list[str]], text: bytes) -> dict[str, Any] | None:
        """Hear a posted word, and return what the page shows."""
        if path == "/word":
            self.dialogue.words.put(text.decode(errors="replace"))
        return self.dialogue.state() if path in ("/word", "/state") else None
