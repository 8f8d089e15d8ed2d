"""What ``ngpt render --live`` costs: the same render with somebody who looks on and without, in turn.

    python -m bench.live glossy --size 640x360 --spp 96 --pairs 3

Who looks on asks each second how far the render is, and fetches each page, as a browser does that draws nothing.
Printed are, for each pair and in the median: seconds of wall clock with over without; seconds of all threads of this
process with over without, which other programs on the machine disturb less; and the share of its time for which the
render stood still.
"""

import argparse
import json
import statistics
import threading
import time
from urllib.request import urlopen

from data_gen.cli.onlook import Onlookers
from data_gen.session import render_scene
from ngpt.cli.arguments import positive, size
from ngpt.report.live import LivePage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene")
    parser.add_argument("--size", type=size, default=(640, 360))
    parser.add_argument("--spp", type=positive, default=96)
    parser.add_argument("--sampler", default="gpt")
    parser.add_argument("--pairs", type=positive, default=3)
    args = parser.parse_args()
    render(args, 16, live=False)  # compiles the kernels
    ratios = []
    for pair in range(args.pairs):
        found = {live: render(args, args.spp, live) for live in ((False, True) if pair % 2 else (True, False))}
        (wall, cpu, still, images), (wall0, cpu0, _, _) = found[True], found[False]
        ratios.append((wall / wall0, cpu / cpu0, still))
        seconds = f"{wall0:.1f} s, live {wall:.1f} s, {images} images"
        print(f"{seconds}: {told(*ratios[-1])}", flush=True)
    print(f"median: {told(*(statistics.median(column) for column in zip(*ratios, strict=True)))}")


def told(wall: float, cpu: float, still: float) -> str:
    return f"wall {wall:.3f}, threads {cpu:.3f}, stood still {still:.2%}"


def render(args: argparse.Namespace, spp: int, live: bool) -> tuple[float, float, float, int]:
    """Seconds of wall clock and of all threads, the share in which the render stood still, and images shown."""
    page = LivePage(args.scene, "bench.live", port=0) if live else None
    looking, over = Onlookers(page, None, print, "spp"), threading.Event()
    if page is not None:
        page.answer("/")  # Somebody is there from the start.
        threading.Thread(target=look_on, args=(page.url, over), daemon=True).start()
    wall, cpu = time.perf_counter(), time.process_time()
    render_scene(
        args.scene, spp, sampler=args.sampler, size=args.size, progress=looking.progress, newest=looking.newest
    )
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    over.set()
    images = page.number if page else 0
    if page is not None:
        page._asked = -1e9
    looking.close()
    return wall, cpu, looking.spent / wall, images


def look_on(url: str, over: threading.Event) -> None:
    seen = 0
    while not over.wait(1.0):
        news = json.loads(urlopen(f"{url}status", timeout=10).read())
        if news["number"] > seen:
            seen = news["number"]
            urlopen(url, timeout=10).read()


if __name__ == "__main__":
    main()
