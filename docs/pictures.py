"""The grasp on the front page, as replay.html and as images/grasp.png: `make pictures`."""

import shutil
from pathlib import Path

import hqp_grasp as hg
from hqp_grasp.experiments.replay import write_replay

DOCS = Path(__file__).parent
PROBES = 12
SHOWN = 5.5  # [s] probe 5: all three arrows of a contact are seen
SIZE = {"width": 1120, "height": 630}
SCENE = {"x": 0, "y": 0, "width": 1120, "height": 588}  # without the time bar
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")

# On the front page the wheel scrolls the page (with Ctrl it comes closer). The picture stands in
# until the scene is there, or for good where there is no WebGL. viser's notes are left out.
INSIDE = """<style>
  body::after { content: ""; position: fixed; inset: 0; background: white no-repeat; }
  body::after { background-image: url(images/grasp.png); background-size: 100% auto; }
  html.drawable body:has(input)::after { display: none; }
  [class*="Notifications-root"] { display: none; }
</style>
<script>
  const drawable = document.createElement("canvas").getContext("webgl2");
  if (drawable) document.documentElement.className = "drawable";
  addEventListener("wheel", event => event.ctrlKey || event.stopImmediatePropagation(), true);
</script>
</head>"""


def replay() -> None:
    """Trial 0 of `make demo`, its first probes."""
    scene = hg.Scene(robot="wam_bhand", object=hg.Cylinder(radius=0.05))
    stack = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()
    record = hg.Trial(scene, stack, probes=PROBES).run(seed=(2, 0))
    path = DOCS / "replay.html"
    write_replay(scene, record, path, "a cylinder of 5 cm radius")
    page = path.read_text(encoding="utf-8")
    path.write_text(page.replace("</head>", INSIDE, 1), encoding="utf-8")


def picture() -> None:
    """The replay at one probe, without its time bar."""
    from playwright.sync_api import sync_playwright

    if CHROMIUM is None:
        raise SystemExit("images/grasp.png needs chromium; Debian, Ubuntu: apt install chromium")
    with sync_playwright() as play:
        flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = play.chromium.launch(executable_path=CHROMIUM, args=flags)
        page = browser.new_page(viewport=SIZE)
        page.goto((DOCS / "replay.html").as_uri())
        time = page.locator("input").first  # the time bar, once the scene is there
        time.wait_for(timeout=120_000)
        page.keyboard.press("Space")
        time.fill(str(SHOWN))
        time.press("Enter")
        page.wait_for_timeout(5000)  # without a GPU it draws a few times a second
        page.screenshot(path=DOCS / "images" / "grasp.png", clip=SCENE)
        browser.close()


if __name__ == "__main__":
    replay()
    picture()
