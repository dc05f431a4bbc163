// The picture says it when the motion passes a singular configuration.
const FLASH = 0.35;  // seconds of the clock on the wall, before and after

at_frame.push((time) => {
  const speed = animator.playing ? animator.mixer.timeScale : 0;
  const near = Math.max(FLASH * speed, animator.duration / 500);
  const here = about.passages.find((passage) => Math.abs(passage.time - time) <= near);
  const flash = element("flash");
  flash.hidden = !here;
  element("view").classList.toggle("singular", Boolean(here));
  if (here && flash.textContent !== here.text) flash.textContent = here.text;
});
