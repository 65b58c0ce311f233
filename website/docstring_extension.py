"""What the builder's reader of docstrings calls for each of them."""

import sys
from pathlib import Path
from typing import Any

from griffe import Alias, Extension, Object

sys.path.insert(0, str(Path(__file__).parent.parent))

from website.docstrings import markdown


class Docstrings(Extension):
    """Code marks and references of the docstrings, before they are read."""

    def on_object(self, *, obj: Object | Alias, **kwargs: Any) -> None:
        """Change one object's docstring."""
        if not obj.is_alias and obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)
