"""What the tutorials' hidden lines use: figures on the page."""

import base64
import io

from matplotlib.figure import Figure

from fusion_gym.output import palette  # the name by which the tutorials import it
from fusion_gym.output.palette import plt

STYLE = {"svg.fonttype": "path", "figure.constrained_layout.use": True, "text.parse_math": True}
plt.rcParams.update(palette.LARGE | STYLE)


def figure_html(figure: Figure) -> str:
    """A figure as HTML; its caption is the paragraph in italics behind the block that prints it."""
    image = io.BytesIO()
    figure.savefig(image, format="svg", metadata={"Date": None})
    plt.close(figure)
    data = base64.b64encode(image.getvalue()).decode()
    return f'<p><img alt="" src="data:image/svg+xml;base64,{data}"></p>'
