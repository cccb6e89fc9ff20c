/** A depth image in false colours with a point that can be read, and the skeletons of tracked people. */
import type { DepthImage } from "../../shared/lib/png";
import { bonesOf, projected } from "../../shared/lib/skeleton";
import type { KnownPeople, KnownPerson } from "../../shared/mqtt/sensor-frames";
import { falseColour } from "../../shared/ui/colour-map";
import { format } from "../../shared/i18n/format";
import { useEffect, useRef, useState } from "preact/hooks";
import { coloured, type DepthScale } from "./model/depth-scale";
import { texts } from "./texts";

export interface Drawn {
  image: DepthImage;
  scale: DepthScale;
  sequence: number;
}

interface Point {
  x: number;
  y: number;
}

interface DepthPictureProps {
  drawn: Drawn;
  /** `null`: not tracked, or not shown on this image. */
  people: KnownPeople | null;
}

export function DepthPicture({ drawn: { image, scale, sequence }, people }: DepthPictureProps) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const legend = useRef<HTMLCanvasElement>(null);
  const [point, setPoint] = useState<Point | null>(null);
  const { width, height } = image;
  const within = (value: number, most: number): number => Math.min(most - 1, Math.max(0, value));

  useEffect(() => {
    canvas.current?.getContext("2d")?.putImageData(new ImageData(coloured(image, scale), width, height), 0, 0);
  }, [image, scale]);
  useEffect(() => {
    if (legend.current !== null) paintLegend(legend.current);
  }, []);

  const move = (event: KeyboardEvent): void => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    const by = event.shiftKey ? 1 : 8;
    const from = point ?? { x: Math.floor(width / 2), y: Math.floor(height / 2) };
    const [right = 0, down = 0] = step;
    setPoint({ x: within(from.x + right * by, width), y: within(from.y + down * by, height) });
  };

  const aim = (event: PointerEvent): void => {
    if (!(event.currentTarget instanceof HTMLElement)) return;
    const box = event.currentTarget.getBoundingClientRect();
    setPoint({
      x: within(Math.floor(((event.clientX - box.left) / box.width) * width), width),
      y: within(Math.floor(((event.clientY - box.top) / box.height) * height), height),
    });
  };

  return (
    <>
      <div
        class="depth-picture"
        role="img"
        tabIndex={0}
        aria-label={texts.depth.label(format.oneDigit(scale.nearM), format.oneDigit(scale.farM))}
        onPointerMove={aim}
        onPointerDown={aim}
        onKeyDown={move}
      >
        <canvas ref={canvas} width={width} height={height} data-testid="depth-picture" data-sequence={sequence} />
        {people !== null && <Skeletons people={people} width={width} height={height} />}
        {point !== null && (
          <span class="crosshair" style={{ left: percent(point.x + 0.5, width), top: percent(point.y + 0.5, height) }} />
        )}
      </div>
      <div class="depth-scale">
        <span>{texts.depth.read(format.oneDigit(scale.nearM))}</span>
        <canvas ref={legend} width={256} height={1} aria-hidden="true" />
        <span>{texts.depth.read(format.oneDigit(scale.farM))}</span>
        <output class="depth-value" data-testid="depth-value">
          {point === null ? format.unknown : reading(image, { x: within(point.x, width), y: within(point.y, height) })}
        </output>
      </div>
    </>
  );
}

interface SkeletonsProps {
  people: KnownPeople;
  /** Size of the picture [px]. */
  width: number;
  height: number;
}

/** Skeletons in the picture of their camera: solid where the sensor sees the joints, dashed where it infers them. */
export function Skeletons({ people, width, height }: SkeletonsProps) {
  return (
    <svg class="skeletons" viewBox={`0 0 ${width} ${height}`} aria-hidden="true" data-testid="skeletons" data-people={people.people.length}>
      {people.people.map((person) => (
        <Skeleton key={person.id} person={person} people={people} width={width} height={height} />
      ))}
    </svg>
  );
}

function Skeleton({ person, people, width, height }: SkeletonsProps & { person: KnownPerson }) {
  const at = (place: readonly [number, number, number]): [number, number] | null => projected(people, [...place], width, height);
  const head = at(person.joints.find(({ name }) => name === "head")?.position_m ?? person.position_m);
  return (
    <g data-testid={`skeleton-${person.id}`} data-joints={person.joints.length}>
      {bonesOf(person).map(({ from, to, tracked }, index) => {
        const [start, end] = [at(from), at(to)];
        if (start === null || end === null) return null;
        return <line key={index} class={tracked ? "" : "inferred"} x1={start[0]} y1={start[1]} x2={end[0]} y2={end[1]} />;
      })}
      {person.joints.map(({ name, position_m: place, state }) => {
        const centre = at(place);
        return centre === null ? null : <circle key={name} class={state} cx={centre[0]} cy={centre[1]} r={height / 100} />;
      })}
      {head !== null && (
        // At the edge the name stays inside the picture.
        <text
          x={Math.min(width * 0.88, Math.max(width * 0.12, head[0]))}
          y={Math.max(height / 16, head[1] - height / 20)}
          font-size={height / 20}
          text-anchor="middle"
        >
          {texts.people.name(person.id)}
        </text>
      )}
    </g>
  );
}

function percent(value: number, of: number): string {
  return `${(100 * value) / of}%`;
}

function reading({ depthM, width }: DepthImage, { x, y }: Point): string {
  const m = depthM[y * width + x] ?? 0;
  return m > 0 ? texts.depth.read(m.toFixed(2)) : texts.depth.outOfRange;
}

function paintLegend(canvas: HTMLCanvasElement): void {
  const image = new ImageData(canvas.width, 1);
  for (let x = 0; x < canvas.width; x += 1) image.data.set([...falseColour(x / (canvas.width - 1)), 255], x * 4);
  canvas.getContext("2d")?.putImageData(image, 0, 0);
}
