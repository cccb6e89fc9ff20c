/** What a robot can be asked to do besides being steered: a card for each ability that its description names. */
import type { ComponentChildren } from "preact";
import type { Fleet } from "../devices/model/device-list";
import type { KnownDescription } from "../../shared/mqtt/parse-messages";
import type { AnyRequest } from "../../shared/api/action-requests";
import type { Station } from "../devices/model/device-session";
import { texts } from "./texts";
import { Foldable } from "../../shared/ui/collapsible-card";
import { Card } from "../../shared/ui/parts";
import { whyNotAct } from "../devices/availability";
import "./actions.css";
import { Look } from "./look-at-card";
import { Place } from "./go-to-place-card";
import { Pose } from "./move-to-pose-card";
import { Behaviours, Expressions, Postures } from "./one-click-actions-card";
import { Speech } from "./speech-card";
import { StiffnessCard } from "./stiffness-card";

export interface ActProps {
  station: Station;
  description: KnownDescription;
  /** Why nothing can be asked for now; empty where it can. */
  no: string;
}

interface ActsProps {
  fleet: Fleet;
  station: Station;
}

export function Acts({ fleet, station }: ActsProps) {
  const description = station.device.description.value;
  if (description === null) return null;
  const no = whyNotAct(station.device, station.control);
  const common: ActProps = { station, description, no };
  const takes = (kind: AnyRequest["kind"]): boolean => description.actions.includes(kind);
  const cards: [string, string, boolean, ComponentChildren][] = [
    ["postures", texts.postures, takes("take_posture") && description.postures.length > 0, <Postures {...common} />],
    ["expressions", texts.expressions, takes("express") && description.expressions.length > 0, <Expressions {...common} />],
    ["behaviours", texts.behaviours, takes("run_behaviour") && description.behaviours.length > 0, <Behaviours {...common} />],
    ["speech", texts.speech, takes("say"), <Speech {...common} />],
    ["pose", texts.pose, takes("move_pose"), <Pose {...common} />],
    ["place", texts.place, takes("go_to"), <Place {...common} fleet={fleet} />],
    ["look", texts.look, takes("look_at"), <Look {...common} />],
    ["stiffness", texts.stiffness, takes("set_stiffness"), <StiffnessCard {...common} />],
  ];
  return (
    <>
      {cards.map(
        ([name, title, there, card]) =>
          there && (
            <Foldable key={name} name={name} title={title} type={description.robot_type}>
              <Card title={title} class="act" aside={no === "" ? undefined : <span class="quiet small act-no">{no}</span>}>
                {card}
              </Card>
            </Foldable>
          ),
      )}
    </>
  );
}

/** Ask for it under our lease, or, without one, under one that the cloud takes for it. */
export function ask({ actions, control }: Station, request: AnyRequest, back?: AnyRequest): void {
  void actions.start(request, control.epoch, back);
}
