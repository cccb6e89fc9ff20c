/** Texts of single sessions and events, as chart and table show them. */
import { format } from "../../../shared/i18n/format";
import { texts as autonomyTexts } from "../texts";
import type { Interval, Mark } from "../model/fleet-timeline";
import { texts } from "./texts";

/** Who had control: the operator, or the operator and the task of the action. */
export function whoOf({ by, holder, task }: Interval): string {
  const name = holder ?? texts.unknownHolder;
  if (by === "person") return name;
  return texts.task(name, task === null ? texts.action : autonomyTexts.task(task));
}

/** When a session ended. */
export function endOf({ lasts, toMs }: Interval): string {
  return lasts ? texts.lasts : format.recentTime(toMs);
}

export function intervalText(interval: Interval): string {
  return texts.interval(whoOf(interval), format.recentTime(interval.fromMs), endOf(interval));
}

export function markText({ kind, atMs, message }: Mark): string {
  return texts.marked(texts.mark[kind], format.recentTime(atMs), message);
}
