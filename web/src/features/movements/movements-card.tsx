/** The movements that a robot can run, with their parameters. */
import { type ActionRunner, released } from "../actions/model";
import type { Control } from "../control/model";
import type { DeviceStore } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useEffect, useState } from "preact/hooks";
import type { Api, Movement } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import type { Parameters } from "../../shared/api/movement-library";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { movementAddress } from "../../shared/routing/routes";
import { ParameterFields, useParameters } from "./parameter-form";
import "./parameter-form.css";

interface MovementsProps {
  api: Api;
  device: DeviceStore;
  control: Control;
  actions: ActionRunner;
  /** The account's id. */
  account: string;
}

type Library = { kind: "loading" } | { kind: "loaded"; items: readonly Movement[] } | { kind: "failed"; why: string };

export function MovementsCard({ api, device, control, actions, account }: MovementsProps) {
  const [library, setLibrary] = useState<Library>({ kind: "loading" });
  const [attempt, setAttempt] = useState(0);
  const [open, setOpen] = useState("");
  const { id, role, owner, robot_type: robotType } = device.info.value;
  const isViewer = role === "viewer";
  useEffect(() => {
    if (isViewer) return undefined;
    let active = true;
    setLibrary({ kind: "loading" });
    api.movements(id).then(
      (items) => active && setLibrary({ kind: "loaded", items }),
      (error: unknown) => active && setLibrary({ kind: "failed", why: sentence(error) }),
    );
    return () => {
      active = false;
    };
  }, [api, id, isViewer, attempt]);

  const run = actions.run.value;
  const running = (run !== null && !released(run)) || (device.live.value && device.state.value?.mode === "action");
  const blocked = running || device.stopped.value || device.reach.value === "offline";
  const start = (name: string, parameters: Parameters): void =>
    void actions.start({ kind: "run_movement", name, parameters }, control.epoch);
  return (
    <Card title={texts.movements.title} class="movements">
      {isViewer && <p class="quiet">{texts.movements.viewer}</p>}
      {!isViewer && library.kind === "loading" && <p class="quiet">{common.loading}</p>}
      {library.kind === "failed" && (
        <p class="notice bad">
          {texts.movements.failed(library.why)}{" "}
          <button type="button" onClick={() => setAttempt(attempt + 1)}>
            {texts.movements.retry}
          </button>
        </p>
      )}
      {library.kind === "loaded" && library.items.length === 0 && <p class="quiet">{texts.movements.none}</p>}
      {library.kind === "loaded" && (
        <ul class="movement-list">
          {library.items.map((movement) => (
            <Row
              key={movement.name}
              movement={movement}
              robotType={robotType}
              account={account}
              // Only the owner can open the library.
              address={owner.id === account ? movementAddress(robotType, movement.name) : null}
              blocked={blocked}
              open={open === movement.name}
              onOpen={() => setOpen(open === movement.name ? "" : movement.name)}
              onRun={(parameters) => start(movement.name, parameters)}
            />
          ))}
        </ul>
      )}
    </Card>
  );
}

interface RowProps {
  movement: Movement;
  robotType: string;
  account: string;
  address: string | null;
  blocked: boolean;
  open: boolean;
  onOpen: () => void;
  onRun: (parameters: Parameters) => void;
}

function Row({ movement, robotType, account, address, blocked, open, onOpen, onRun }: RowProps) {
  const { name, description, built_in: builtIn, parameters_schema: schema } = movement;
  const hasParameters = Object.keys(schema?.properties ?? {}).length > 0;
  // Required parameters have no default.
  const hasRequired = (schema?.required ?? []).length > 0;
  return (
    <li class={open ? "open" : ""}>
      <span>
        {address === null ? <strong>{name}</strong> : <a href={address}><strong>{name}</strong></a>}{" "}
        {!builtIn && <span class="chip">{texts.movements.own}</span>}
        <span class="quiet small">{description}</span>
      </span>
      <span class="row">
        {hasParameters && (
          <button
            type="button"
            class="plain"
            aria-expanded={open}
            aria-label={texts.parameters.of(name)}
            data-testid={`parameters-${name}`}
            onClick={onOpen}
          >
            {texts.parameters.title}
          </button>
        )}
        {!open && (
          <button
            type="button"
            data-testid={`movement-${name}`}
            aria-label={texts.movements.runNamed(name)}
            disabled={blocked}
            title={hasParameters ? texts.parameters.withDefaults : undefined}
            onClick={() => (hasRequired ? onOpen() : onRun({}))}
          >
            {texts.movements.run}
          </button>
        )}
      </span>
      {open && <Form name={name} robotType={robotType} account={account} movement={movement} blocked={blocked} onRun={onRun} />}
    </li>
  );
}

interface FormProps {
  name: string;
  robotType: string;
  account: string;
  movement: Movement;
  blocked: boolean;
  onRun: (parameters: Parameters) => void;
}

function Form({ name, robotType, account, movement, blocked, onRun }: FormProps) {
  const values = useParameters(account, robotType, name, movement.parameters_schema);
  return (
    <form
      class="parameter-form"
      data-testid="parameter-form"
      onSubmit={(event) => {
        event.preventDefault();
        const parameters = values.submit();
        if (parameters !== null) onRun(parameters);
      }}
    >
      <ParameterFields values={values} />
      <div class="row">
        <button type="submit" class="primary" data-testid="run-with" disabled={blocked}>
          {texts.movements.runNamed(name)}
        </button>
        <button type="button" class="plain" onClick={values.reset}>
          {texts.parameters.reset}
        </button>
      </div>
    </form>
  );
}
