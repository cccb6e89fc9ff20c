/** Chooses, aligns and describes a comparison of two sessions. The address of the page keeps it. */
import type { Api } from "../../../../shared/api/client";
import { format } from "../../../../shared/i18n/format";
import { sessionAddress } from "../../../../shared/routing/routes";
import { Card } from "../../../../shared/ui/card";
import { LoadError } from "../../../../shared/ui/load-error";
import type { DeviceStore, Fleet } from "../../../devices/model";
import type { Replay } from "../../model/recording";
import { type Comparison, type Selection, selectionText } from "../../model/recording/comparison";
import { AlignForm } from "./align-form";
import { ChooseSession } from "./choose-session";
import { FiguresTable, JointTable } from "./difference-tables";
import { texts } from "./texts";
import type { Compared } from "./use-comparison";

interface CompareCardProps extends Compared {
  api: Api;
  fleet: Fleet;
  device: DeviceStore;
  replay: Replay;
}

export function CompareCard({ api, fleet, device, replay, selection, comparison, error }: CompareCardProps) {
  const epoch = replay.session.value?.epoch ?? 0;
  const select = (next: Selection | null): void => {
    location.hash = sessionAddress(device.id, epoch, next === null ? "" : selectionText(next));
  };
  return (
    <Card title={texts.title} class="session-compare" data-testid="compare-card">
      {error !== "" && (
        <p class="notice warn" role="alert" data-testid="compare-error">
          {error}
        </p>
      )}
      {comparison === null || selection === null ? (
        <>
          <p class="quiet small">{texts.explained}</p>
          <ChooseSession api={api} fleet={fleet} device={device} epoch={epoch} onChoose={(id, chosen) => select({ device: id, epoch: chosen, first_s: 0, second_s: 0 })} />
        </>
      ) : (
        <>
          <Links fleet={fleet} device={device} epoch={epoch} comparison={comparison} selection={selection} onEnd={() => select(null)} />
          <Result comparison={comparison} device={device} />
          <AlignForm comparison={comparison} onAlign={(alignment) => select({ ...selection, ...alignment })} />
        </>
      )}
    </Card>
  );
}

interface LinksProps {
  fleet: Fleet;
  device: DeviceStore;
  epoch: number;
  comparison: Comparison;
  selection: Selection;
  onEnd: () => void;
}

/** The other session, and links to it and to the reverse comparison. */
function Links({ fleet, device, epoch, comparison, selection, onEnd }: LinksProps) {
  const session = comparison.second.session.value;
  const label = fleet.devices.value?.get(selection.device)?.info.value.label ?? selection.device;
  const start = session?.started_at ?? null;
  const swapped = selectionText({ device: device.id, epoch, first_s: selection.second_s, second_s: selection.first_s });
  return (
    <p class="row">
      <strong data-testid="compared-session">{texts.of(label, session?.holder ?? texts.unknown, start === null ? format.unknown : format.dateTime(start))}</strong>
      <a href={sessionAddress(selection.device, selection.epoch)}>{texts.open}</a>
      <a href={sessionAddress(selection.device, selection.epoch, swapped)}>{texts.swap}</a>
      <button type="button" class="plain" data-testid="end-comparison" onClick={onEnd}>
        {texts.end}
      </button>
    </p>
  );
}

function Result({ comparison, device }: { comparison: Comparison; device: DeviceStore }) {
  const state = comparison.state.value;
  const reason = comparison.second.error.value;
  return (
    <>
      <LoadError reason={reason} retry={() => void comparison.second.retry()} />
      {state !== "ready" && reason === "" && (
        <p class={state === "loading" ? "quiet" : "notice warn"} role="status" data-testid="compare-state" data-state={state}>
          {texts.state[state]}
        </p>
      )}
      {comparison.partial.value && state === "ready" && <p class="quiet small">{texts.partial}</p>}
      {state === "ready" && <p class="small">{texts.overlap(comparison.differences.value.overlap_s)}</p>}
      {(state === "ready" || state === "apart") && (
        <div class="session-tables">
          <FiguresTable comparison={comparison} />
          {state === "ready" && <JointTable comparison={comparison} device={device} />}
        </div>
      )}
    </>
  );
}
