import { unavailableReason } from "../devices";
import type { DeviceStore } from "../devices/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import { useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../../shared/api/http";
import { now } from "../../shared/lib/clock";
import type { RoomDeviceAction } from "./model/room-device-action";
import { readDepth, type DepthImage } from "../../shared/lib/png";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { contentOf } from "./use-capture-content";
import { falseColour, MISSING_COLOUR } from "../../shared/ui/colour-map";

interface Drawn extends DepthImage {
  nearM: number;
  farM: number;
  at: number;
}

interface Point {
  x: number;
  y: number;
}

/** Depth image: near is dark, far is light, out of range is grey. Every point can be read. */
export function DepthCard({ device, roomAction }: { device: DeviceStore; roomAction: RoomDeviceAction }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const scale = useRef<HTMLCanvasElement>(null);
  const [drawn, setDrawn] = useState<Drawn | null>(null);
  const [point, setPoint] = useState<Point | null>(null);
  const [error, setError] = useState("");

  const capture = async (): Promise<void> => {
    const file = await roomAction.capture("depth");
    if (file === null) return;
    try {
      const image = await readDepth(await contentOf(file));
      const distances = image.depthM.filter((m) => m > 0).sort();
      const [nearM, farM] = [distances[0] ?? 0, distances.at(-1) ?? 1];
      setDrawn({ ...image, nearM: Math.floor(nearM * 10) / 10, farM: Math.ceil(farM * 10) / 10, at: now() });
      setError("");
    } catch (error) {
      setError(sentence(error));
    }
  };

  useEffect(() => {
    if (drawn === null || canvas.current === null || scale.current === null) return;
    paint(canvas.current, drawn);
    paintScale(scale.current);
  }, [drawn]);

  const move = (event: KeyboardEvent): void => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (drawn === null || step === undefined) return;
    event.preventDefault();
    const by = event.shiftKey ? 1 : 8;
    const from = point ?? { x: Math.floor(drawn.width / 2), y: Math.floor(drawn.height / 2) };
    const within = (value: number, most: number): number => Math.min(most - 1, Math.max(0, value));
    const [right = 0, down = 0] = step;
    setPoint({ x: within(from.x + right * by, drawn.width), y: within(from.y + down * by, drawn.height) });
  };

  const aim = (event: PointerEvent): void => {
    if (drawn === null || !(event.currentTarget instanceof HTMLElement)) return;
    const box = event.currentTarget.getBoundingClientRect();
    const at = (share: number, most: number): number => Math.min(most - 1, Math.max(0, Math.floor(share * most)));
    setPoint({
      x: at((event.clientX - box.left) / box.width, drawn.width),
      y: at((event.clientY - box.top) / box.height, drawn.height),
    });
  };

  const unavailable = unavailableReason(device);
  const busy = roomAction.busy.value !== null;
  return (
    <Card title={texts.depth.title} class="picture">
      <div class={`depth-box ${device.live.value ? "" : "old"}`}>
        {drawn === null ? (
          <p class="over quiet">{texts.depth.none}</p>
        ) : (
          <div
            class="depth-picture"
            role="img"
            tabIndex={0}
            aria-label={texts.depth.label(format.oneDigit(drawn.nearM), format.oneDigit(drawn.farM))}
            onPointerMove={aim}
            onPointerDown={aim}
            onKeyDown={move}
          >
            <canvas ref={canvas} width={drawn.width} height={drawn.height} data-testid="depth-picture" />
            {point !== null && (
              <span class="crosshair" style={{ left: percent(point.x + 0.5, drawn.width), top: percent(point.y + 0.5, drawn.height) }} />
            )}
          </div>
        )}
      </div>
      {drawn !== null && (
        <div class="depth-scale">
          <span>{texts.depth.read(format.oneDigit(drawn.nearM))}</span>
          <canvas ref={scale} width={256} height={1} aria-hidden="true" />
          <span>{texts.depth.read(format.oneDigit(drawn.farM))}</span>
          <output class="depth-value" data-testid="depth-value">
            {point === null ? format.unknown : reading(drawn, point)}
          </output>
        </div>
      )}
      {drawn !== null && (
        <p class="quiet small">
          {texts.depth.hint} {texts.depth.noReading}
        </p>
      )}
      <div class="row">
        <button type="button" class="primary" data-testid="depth-shot" disabled={unavailable !== "" || busy} title={unavailable} onClick={() => void capture()}>
          {busy ? texts.camera.taking : drawn === null ? texts.depth.shot : texts.depth.again}
        </button>
        <span class="quiet small">
          {drawn !== null && <Age at={drawn.at} as={(age) => texts.depth.captured(drawn.width, drawn.height, age)} />}
        </span>
      </div>
      {roomAction.error.value !== "" && <p class="notice bad">{roomAction.error.value}</p>}
      {error !== "" && <p class="notice bad">{error}</p>}
    </Card>
  );
}

function percent(value: number, of: number): string {
  return `${(100 * value) / of}%`;
}

function reading({ depthM, width }: Drawn, { x, y }: Point): string {
  const m = depthM[y * width + x] ?? 0;
  return m > 0 ? texts.depth.read(m.toFixed(2)) : texts.depth.outOfRange;
}

function paint(canvas: HTMLCanvasElement, { width, height, depthM, nearM, farM }: Drawn): void {
  const image = new ImageData(width, height);
  depthM.forEach((m, index) => {
    const [red, green, blue] = m > 0 ? falseColour((m - nearM) / Math.max(0.001, farM - nearM)) : MISSING_COLOUR;
    image.data.set([red, green, blue, 255], index * 4);
  });
  canvas.getContext("2d")?.putImageData(image, 0, 0);
}

function paintScale(canvas: HTMLCanvasElement): void {
  const image = new ImageData(canvas.width, 1);
  for (let x = 0; x < canvas.width; x += 1) image.data.set([...falseColour(x / (canvas.width - 1)), 255], x * 4);
  canvas.getContext("2d")?.putImageData(image, 0, 0);
}
