"""What a page consists of, and whether it is whole."""

from html.parser import HTMLParser


class Outline(HTMLParser):
    """Headings, the sentences and pictures below each, and whether every tag is closed."""

    VOID = frozenset({"meta", "br"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []
        self.sentences: dict[str, str] = {}
        self.pictures: list[str] = []
        self.says = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        if tag in {"h1", "h2"}:
            self.headings.append("")
        if tag == "svg":
            self.pictures.append(self.headings[-1])
        self.says = self.says or ("class", "says") in attrs

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        self.says = self.says and tag != "p"

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in {"h1", "h2"}:
            self.headings[-1] += data
        if self.says and self.headings:
            self.sentences[self.headings[-1]] = self.sentences.get(self.headings[-1], "") + data


def outline(text: str) -> Outline:
    found = Outline()
    found.feed(text)
    assert found.open == []
    return found
