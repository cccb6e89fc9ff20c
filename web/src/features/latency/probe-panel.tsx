/** Measures latency now, without motion. */
import type { DeviceStore } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { TIMES, probeKindsOf, type LatencyProbe } from "./model/probe";
import { texts } from "./texts";

export function ProbePanel({ device, measure }: { device: DeviceStore; measure: LatencyProbe }) {
  const progress = measure.progress.value;
  const why = measure.why.value;
  const ways = probeKindsOf(device);
  const count = measure.lines.reduce((sum, { samples }) => sum + samples.length, 0);
  const watches = device.info.value.role === "viewer";
  const done = progress === null ? 0 : ways.indexOf(progress.way) * TIMES + progress.done;
  return (
    <Card
      title={texts.measure}
      aside={
        progress === null ? (
          // The supported probes are known after the description has arrived.
          <button
            type="button"
            class="primary"
            data-testid="measure"
            disabled={device.description.value === null}
            onClick={() => void measure.run(ways)}
          >
            {texts.measure}
          </button>
        ) : (
          <button type="button" data-testid="measure-stop" onClick={() => measure.stop()}>
            {texts.stop}
          </button>
        )
      }
    >
      <p class="quiet small">
        {texts.measureExplained(ways.map((way) => texts.ways[way]))} {!ways.includes("device") && texts.robotNote}{" "}
        {watches && texts.viewer}
      </p>
      {progress !== null && (
        <>
          <progress max={ways.length * TIMES} value={done} aria-label={texts.measure} />
          <p class="small">{texts.measuring(texts.ways[progress.way], progress.done, progress.of)}</p>
        </>
      )}
      <p class="small" role="status" data-testid="measured" data-count={count} data-busy={progress !== null}>
        {progress === null && count > 0 && texts.measureDone(count)}
      </p>
      {why !== "" && (
        <p class="notice bad" role="alert">
          {texts.ended(why)}
        </p>
      )}
      {measure.unstored && !watches && (
        <p class="row">
          {texts.notStored}
          <button type="button" onClick={() => void measure.store()}>
            {texts.store}
          </button>
        </p>
      )}
    </Card>
  );
}
