"""What MkDocs calls while it builds the site: pages made from the code, and what a page of the repository needs to
become a page of the site.

Nothing in the site is loaded from another host: Mermaid's diagrams become SVG here, and links to files of the
repository that are no pages become plain words.
"""

import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(HERE), str(ROOT)]

import generated_pages  # noqa: E402
import mermaidx  # noqa: E402
import reference_tables  # noqa: E402
from mkdocs.structure.files import File, Files  # noqa: E402

_MERMAID = re.compile(r"^```mermaid\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!\w+:)([^)\s]+)\)")
_PICTURE = re.compile(
    r"<picture>.*?srcset=\"([^\"]+)\".*?<img alt=\"([^\"]*)\" src=\"([^\"]+)\">.*?</picture>", re.DOTALL
)


def on_files(files: Files, config: Any) -> Files:
    """Adds the pages that are made from the code."""
    for path, text in generated_pages.pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Diagrams as SVG, pictures for light and dark, links that lead out of the docs as words."""
    depth = page.file.src_uri.count("/")
    number = 0

    def diagram(match: re.Match[str]) -> str:
        nonlocal number
        number += 1
        links = []
        for scheme, theme in (("light", "default"), ("dark", "dark")):
            path = f"diagrams/{page.file.src_uri.removesuffix('.md').replace('/', '-')}-{number}-{scheme}.svg"
            source = f"%%{{init: {{'theme': '{theme}'}}}}%%\n{match[1]}"
            content = mermaidx.render(source).svg()
            files.append(File.generated(config, path, content=content))
            links.append(f"![diagram]({'../' * depth}{path}#only-{scheme})")
        return "\n".join(links)

    def picture(match: re.Match[str]) -> str:
        dark, words, light = match.groups()
        return f"![{words}]({light}#only-light)\n![{words}]({dark}#only-dark)"

    markdown = _MERMAID.sub(diagram, reference_tables.with_tables(markdown))
    markdown = _PICTURE.sub(picture, markdown)
    return _LINK.sub(lambda m: m[0] if _is_in_the_site(m[2], page) else m[1], markdown)


def _is_in_the_site(target: str, page: Any) -> bool:
    """Whether a relative link ends at a page or picture of docs/; what is not there at all MkDocs complains of."""
    path = (ROOT / "docs" / page.file.src_uri).parent / target.partition("#")[0]
    is_shown = path.suffix in (".md", ".png", ".svg")
    return not target.partition("#")[0] or (is_shown and path.resolve().is_relative_to(ROOT / "docs"))
