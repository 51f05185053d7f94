"""Films a drive on the page in the browser, for README: python docs/film_playground.py. It needs Chromium and its driver.

Keys drive the robot towards the goal. The page computes and draws each moment when it is told to, so the film does not
depend on the speed of the machine.
"""

import io
import shutil
import tempfile
from pathlib import Path

from PIL import Image
from selenium import webdriver

from ballbot_gym import files
from ballbot_train.report.playground import playground_page

PATH = Path(__file__).parent / "pictures" / "playground.webp"
_SIZE, _WIDTH, _QUALITY = "720,900", 560, 30  # px of the window and of the film, and WebP's quality
_STEPS, _SHOWN_MS, _LAST_MS = 5, 100, 3000  # control steps of 0.02 s per picture, and how long a picture is shown

_DRIVEN = """
const [mine] = playground.robots, view = document.activeElement;
const press = (key, isHeld) => view.dispatchEvent(new KeyboardEvent(isHeld ? "keydown" : "keyup", { key }));
for (let i = 0; i < arguments[0] && !mine.over; i++) {
  const wanted = [0, 1].map((i) => -0.1 * mine.x[i] - 0.15 * mine.x[4 + i]);
  for (const [key, along] of Object.entries(ARROWS).slice(0, 4)) {
    const [a, b] = playground.onFloor(...along);
    press(key, a * wanted[0] + b * wanted[1] > 0.5);
  }
  playground.advance();
}
playground.draw(arguments[0] / 50);
playground.showNumbers();
return mine.over;
"""


def main() -> None:
    """Drives, takes a picture every 0.1 s, and writes the film."""
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text(playground_page(), encoding="utf-8")
        options = webdriver.ChromeOptions()
        for flag in ("headless", "no-sandbox", "hide-scrollbars", "enable-unsafe-swiftshader", f"window-size={_SIZE}"):
            options.add_argument(f"--{flag}")
        browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
        try:
            browser.get(page.as_uri())
            browser.find_element("css selector", ".drive").click()
            browser.execute_script(
                "playground.tick = () => {}; playground.countdown = 0; document.querySelector('.count').textContent = ''"
            )
            shots, over = [_shot(browser)], False
            while not over:
                over = browser.execute_script(_DRIVEN, _STEPS)
                shots.append(_shot(browser))
        finally:
            browser.quit()
    first, *others = shots
    durations, buffer = [_SHOWN_MS] * len(others) + [_LAST_MS], io.BytesIO()
    kwargs = {"save_all": True, "append_images": others, "duration": durations, "loop": 0}
    first.save(buffer, "WEBP", quality=_QUALITY, method=6, **kwargs)
    files.write(PATH, buffer.getvalue())
    print(f"{PATH.name}: {len(shots)} pictures, {len(buffer.getvalue()) / 1000:.0f} kB")


def _shot(browser: webdriver.Chrome) -> Image.Image:
    shot = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
    return shot.resize((_WIDTH, round(shot.height * _WIDTH / shot.width)), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    main()
