"""What a figure must keep to be read on a printed page: its width, its letters, whole words."""

from matplotlib.backends.backend_agg import FigureCanvasAgg

PAGE_WIDTH = 7.3  # inches: A4 less margins of an inch
SMALLEST_LETTERS = 8.0  # points
_CUT = 3.0  # pixels at 72 to the inch: the empty edge of a letter's box


def unreadable(figure):
    """What is wrong with a figure on paper, as a list of sentences."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    wrong = []
    width, height = figure.get_size_inches()
    if width > PAGE_WIDTH:
        wrong.append(f"it is {width:.1f} inches wide")
    boxes = []
    pixels = figure.dpi
    for text in _texts(figure):
        words, box = text.get_text().strip(), text.get_window_extent(canvas.get_renderer())
        if not words:
            continue
        if text.get_fontsize() < SMALLEST_LETTERS:
            wrong.append(f"{words!r} has letters of {text.get_fontsize():.1f} points")
        cut = _CUT * pixels / 72
        inside = box.x0 > -cut and box.y0 > -cut
        if not inside or box.x1 > width * pixels + cut or box.y1 > height * pixels + cut:
            wrong.append(f"{words!r} runs off the figure")
        boxes.append((words, box))
    for place, (words, box) in enumerate(boxes):
        for others, other in boxes[place + 1 :]:
            across = min(box.x1, other.x1) - max(box.x0, other.x0)
            along = min(box.y1, other.y1) - max(box.y0, other.y0)
            if min(across, along) > 0.35 * min(box.height, other.height, box.width, other.width):
                wrong.append(f"{words!r} lies over {others!r}")
    return wrong


def _texts(figure):
    """All texts that are drawn; ticks outside the limits of their axis are not."""
    for legend in figure.legends:
        yield from legend.get_texts()
    for axes in figure.axes:
        yield axes.title
        yield axes._left_title
        yield from axes.texts
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            yield axis.label
            low, high = sorted(limits)
            if axis.get_tick_params()["labelbottom" if axis is axes.xaxis else "labelleft"]:
                for tick in axis.get_major_ticks():
                    if low <= tick.get_loc() <= high:
                        yield tick.label1
