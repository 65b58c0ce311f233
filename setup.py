"""The packages, and the text of the package's page: the README with absolute links."""

import re
from pathlib import Path

from setuptools import find_packages, setup

SITE = "https://github.com/fusion-gym/fusion-gym/blob/main/"
text = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
text = re.sub(r"(!\[[^]]*\]\()(?!\w+:)", rf"\g<1>{SITE.replace('blob', 'raw')}", text)
text = re.sub(r"(?<!!)(\[[^]]*\]\()(?!\w+:|#)", rf"\g<1>{SITE}", text)
setup(
    packages=[*find_packages(include=["fusion_gym*"]), "fusion_gym.configs"],
    long_description=text,
    long_description_content_type="text/markdown",
)
