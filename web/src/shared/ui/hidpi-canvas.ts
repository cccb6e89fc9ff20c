/** Keeps a canvas at device resolution: draws now, and again when its size changes. */
export function canvasBox(
  canvas: HTMLCanvasElement,
  draw: (context: CanvasRenderingContext2D, width: number, height: number) => void,
): () => void {
  const paint = (): void => {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const context = canvas.getContext("2d");
    if (context === null || width === 0 || height === 0) return;
    const ratio = Math.min(3, devicePixelRatio);
    const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
    // Setting the size clears the canvas, even if it is unchanged.
    if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    draw(context, width, height);
  };
  paint();
  const observer = new ResizeObserver(paint);
  observer.observe(canvas);
  return () => observer.disconnect();
}
