/** What a robot can be asked to do besides being steered: a card for each ability that its description names. */
import type { ComponentChildren } from "preact";
import type { Fleet } from "../../core/fleet";
import type { KnownDescription } from "../../core/messages";
import type { AnyRequest } from "../../core/requests";
import type { Station } from "../../core/station";
import { texts } from "../../texts";
import { Foldable } from "../fold";
import { Card } from "../parts";
import { whyNotAct } from "../usable";
import "./acts.css";
import { Look } from "./look";
import { Place } from "./place";
import { Pose } from "./pose";
import { Behaviours, Expressions, Postures } from "./shows";
import { Speech } from "./speech";
import { StiffnessCard } from "./stiffness";

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
    ["postures", texts.acts.postures, takes("take_posture") && description.postures.length > 0, <Postures {...common} />],
    ["expressions", texts.acts.expressions, takes("express") && description.expressions.length > 0, <Expressions {...common} />],
    ["behaviours", texts.acts.behaviours, takes("run_behaviour") && description.behaviours.length > 0, <Behaviours {...common} />],
    ["speech", texts.acts.speech, takes("say"), <Speech {...common} />],
    ["pose", texts.acts.pose, takes("move_pose"), <Pose {...common} />],
    ["place", texts.acts.place, takes("go_to"), <Place {...common} fleet={fleet} />],
    ["look", texts.acts.look, takes("look_at"), <Look {...common} />],
    ["stiffness", texts.acts.stiffness, takes("set_stiffness"), <StiffnessCard {...common} />],
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
