/** The keyframe editor of a robot type without a robot: only the model moves. */
import { robotOf } from "./model/robot-of-type";
import { useCallback, useMemo } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { useResource } from "../../shared/hooks/use-resource";
import { movementAddress, movementsAddress, typeKeyframesAddress } from "../../shared/routing/routes";
import { KeyframeEditor } from "./editor";
import { LoadMovement, useMovementSource } from "./load-movement";

interface TypeKeyframesPageProps {
  api: Api;
  robotType: string;
  name: string;
}

export function TypeKeyframesPage({ api, robotType, name }: TypeKeyframesPageProps) {
  const type = useResource(useCallback(() => api.robotTypes.get(robotType), [api, robotType]));
  const model = useResource(useCallback(() => api.robotTypes.model(robotType), [api, robotType]));
  const robot = useMemo(() => (type.value === null ? null : robotOf(type.value)), [type.value]);
  const loaded = useMovementSource(api, robotType, name);
  const failed = type.error !== "" ? type : model;
  return (
    <main class="page kf-page" id="content">
      <div class="heading">
        <a href={name === "" ? movementsAddress : movementAddress(robotType, name)}>← {name === "" ? texts.library : name}</a>
        <h1>{texts.title}</h1>
        <p class="quiet">
          {type.value?.label ?? robotType.replaceAll("_", " ")}
          {name !== "" && ` · ${name}`}
        </p>
      </div>
      {failed.error !== "" && (
        <p class="notice bad" role="alert">
          {failed.error}{" "}
          <button type="button" onClick={failed.reload}>
            {common.tryAgain}
          </button>
        </p>
      )}
      <LoadMovement robotType={robotType} name={name} {...loaded}>
        {(source) => (
          <KeyframeEditor
            api={api}
            name={name}
            source={source}
            robotType={robotType}
            robot={robot}
            twin={model.value?.twin ?? null}
            measured={null}
            home={type.value?.home_rad}
            waitsForPose={type.value === null}
            session={null}
            address={(saved) => typeKeyframesAddress(robotType, saved)}
          />
        )}
      </LoadMovement>
    </main>
  );
}
