/** Measures latency now, without motion. */
import type { DeviceStore } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { SAMPLES_PER_KIND, probeKindsOf, type LatencyProbe } from "./model/probe";
import { texts } from "./texts";

export function ProbePanel({ device, probe }: { device: DeviceStore; probe: LatencyProbe }) {
  const progress = probe.progress.value;
  const error = probe.error.value;
  const kinds = probeKindsOf(device);
  const count = probe.lines.reduce((sum, { samples }) => sum + samples.length, 0);
  const isViewer = device.info.value.role === "viewer";
  const done = progress === null ? 0 : kinds.indexOf(progress.kind) * SAMPLES_PER_KIND + progress.done;
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
            onClick={() => void probe.run(kinds)}
          >
            {texts.measure}
          </button>
        ) : (
          <button type="button" data-testid="measure-stop" onClick={() => probe.stop()}>
            {texts.stop}
          </button>
        )
      }
    >
      <p class="quiet small">
        {texts.measureExplained(kinds.map((kind) => texts.probes[kind]))} {!kinds.includes("device") && texts.robotNote}{" "}
        {isViewer && texts.viewer}
      </p>
      {progress !== null && (
        <>
          <progress max={kinds.length * SAMPLES_PER_KIND} value={done} aria-label={texts.measure} />
          <p class="small">{texts.measuring(texts.probes[progress.kind], progress.done, progress.total)}</p>
        </>
      )}
      <p class="small" role="status" data-testid="probe-samples" data-count={count} data-busy={progress !== null}>
        {progress === null && count > 0 && texts.measureDone(count)}
      </p>
      {error !== "" && (
        <p class="notice bad" role="alert">
          {texts.ended(error)}
        </p>
      )}
      {probe.unstored && !isViewer && (
        <p class="row">
          {texts.notStored}
          <button type="button" onClick={() => void probe.store()}>
            {texts.store}
          </button>
        </p>
      )}
    </Card>
  );
}
