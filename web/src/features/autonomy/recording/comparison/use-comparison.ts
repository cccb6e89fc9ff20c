/** The comparison that the address of a session page names. */
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../../../shared/api/client";
import { storedFile } from "../../../../shared/api/recordings";
import type { DeviceStore, Fleet } from "../../../devices/model";
import { Replay, SegmentLoader } from "../../model/recording";
import { Comparison, readSelection, type Selection } from "../../model/recording/comparison";
import { texts } from "./texts";

/** `error`: why the selected session cannot be compared, or "". `comparison` null: none is selected, or it cannot be compared. */
export interface Compared {
  selection: Selection | null;
  comparison: Comparison | null;
  error: string;
}

/** `other`: the part of the address that selects the second session; "" selects none. */
export function useComparison(api: Api, fleet: Fleet, device: DeviceStore, replay: Replay | null, other: string): Compared {
  const [comparison, setComparison] = useState<Comparison | null>(null);
  const selection = readSelection(other);
  const error = selection === null ? (other === "" ? "" : texts.invalid) : refusal(fleet, device, selection);
  const wanted = selection === null || error !== "" ? "" : `${selection.device},${selection.epoch}`;
  useEffect(() => {
    if (wanted === "" || replay === null) return undefined;
    const [id = "", epoch = ""] = wanted.split(",");
    const loader = new SegmentLoader();
    const second = new Replay({
      session: () => api.recordings.of(id, Number(epoch)),
      file: storedFile,
      segment: (...call) => loader.load(...call),
      save: () => Promise.reject(new Error("Open the other session to change its episodes.")),
    });
    const created = new Comparison(replay, second);
    setComparison(created);
    void second.refresh();
    return () => {
      created.dispose();
      second.dispose();
      loader.dispose();
      setComparison(null);
    };
  }, [api, replay, wanted]);
  useEffect(() => {
    if (comparison !== null && selection !== null) comparison.align(selection);
  }, [comparison, other]);
  return { selection, comparison, error };
}

function refusal(fleet: Fleet, device: DeviceStore, { device: id }: Selection): string {
  const found = fleet.devices.value?.get(id);
  if (found === undefined) return texts.missing;
  const [mine, type] = [device.info.value.robot_type, found.info.value.robot_type];
  return mine === type ? "" : texts.otherType(mine, type);
}
