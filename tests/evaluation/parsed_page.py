"""What is in a page, for all tests of pages that a program writes."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser

import cv2
import numpy as np


class Page(HTMLParser):
    """Collects tags with their attributes, and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.text = text
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words += data + " "

    def assert_alone(self) -> None:
        """It fetches nothing, runs nothing and leads nowhere but within itself."""
        names = {tag for tag, _ in self.tags}
        assert not names & {"script", "link", "iframe", "object", "embed", "form", "base"}
        attributes = [pair for _, pairs in self.tags for pair in pairs.items()]
        assert not [key for key, _ in attributes if key.startswith("on")]
        for key, value in attributes:
            if key in ("src", "srcset"):
                assert re.match(r"data:image/(png|jpeg);base64,", str(value))
            if key == "href":
                assert re.fullmatch(r"#case-\d+", str(value))
        assert not re.search(r"https?://|url\(", self.text)
        policies = [pairs["content"] for _, pairs in self.tags if "http-equiv" in pairs]
        assert policies == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]

    def pictures(self) -> tuple[int, int]:
        """How many there are by day and by night; each can be decoded and is told in words."""
        images = [pairs for tag, pairs in self.tags if tag == "img"]
        darks = [pairs["srcset"] for tag, pairs in self.tags if tag == "source"]
        assert all(pairs.get("alt") for pairs in images)
        for uri in [*(pairs["src"] for pairs in images), *darks]:
            raw = np.frombuffer(base64.b64decode(str(uri).split(",")[1]), np.uint8)
            assert cv2.imdecode(raw, cv2.IMREAD_COLOR) is not None
        return len(images), len(darks)
