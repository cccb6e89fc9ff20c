/** Pairs an agent by its code or link with a space, then names its devices. */
import type { Account, Device, Space } from "../../shared/api/types";
import { LastSeenAge, ReachChip, RenameDevice } from "../devices";
import type { Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { ApiError, sentence } from "../../shared/api/http";
import { readCode, type FollowedCode } from "./model/claim-code";
import { common } from "../../shared/i18n/common";
import { accountLabel } from "../../shared/lib/account-label";
import { texts } from "./texts";
import "./pairing.css";
import { deviceAddress, deviceListAddress } from "../../shared/routing/routes";

interface PairingPageProps {
  api: Api;
  account: Account;
  fleet: Fleet;
  pairing: FollowedCode;
}

export function PairingPage({ api, account, fleet, pairing }: PairingPageProps) {
  const [paired, setPaired] = useState<readonly Device[] | null>(null);
  return (
    <main class="page pairing" id="content">
      <p>
        <a href={deviceListAddress}>← {common.allDevices}</a>
      </p>
      <h1>{texts.title}</h1>
      {paired === null ? (
        <PairForm
          api={api}
          account={account}
          fleet={fleet}
          pairing={pairing}
          onPaired={(devices) => {
            pairing.drop();
            setPaired(devices);
          }}
        />
      ) : (
        <Paired api={api} fleet={fleet} devices={paired} onAnother={() => setPaired(null)} />
      )}
    </main>
  );
}

const NEW = "new";

interface PairFormProps extends PairingPageProps {
  onPaired: (devices: readonly Device[]) => void;
}

/** A link never claims a code without a click. Input stays until the pairing succeeds. */
function PairForm({ api, account, fleet, pairing, onPaired }: PairFormProps) {
  const linked = pairing.code.value;
  const [typed, setTyped] = useState(linked ?? "");
  const [spaces, setSpaces] = useState<readonly Space[] | null>(null);
  const [space, setSpace] = useState("");
  const [name, setName] = useState("");
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  const code = useRef<HTMLInputElement>(null);

  useEffect(() => {
    if (linked !== null) setTyped(linked);
  }, [linked]);
  useEffect(() => {
    code.current?.focus();
    // Without the list, the server pairs the agent into the first space.
    api.spaces().then(
      (all) => setSpaces(all.filter(({ role }) => role === "owner")),
      () => setSpaces([]),
    );
  }, [api]);

  const targetSpace = async (): Promise<string | null> => {
    if (space !== NEW) return space === "" ? null : space;
    const created = await api.createSpace(name.trim());
    // The space exists now, even if pairing fails: a retry uses it and does not create a second one.
    setSpaces([...(spaces ?? []), created]);
    setSpace(created.id);
    return created.id;
  };

  const pair = async (): Promise<void> => {
    const claimCode = readCode(typed);
    if (claimCode === null) {
      setError(texts.malformed);
      code.current?.focus();
      return;
    }
    setError("");
    setBusy(true);
    try {
      onPaired(await fleet.claim(claimCode, await targetSpace()));
    } catch (error) {
      const unknown = error instanceof ApiError && error.code === "claim-code-unknown";
      setError(unknown ? texts.unknown : sentence(error));
      setBusy(false);
      code.current?.focus();
    }
  };

  return (
    <Card title={texts.byCode}>
      <p class="quiet">{linked === null ? texts.explain : texts.linked}</p>
      <p class="quiet">{texts.into(accountLabel(account.name, account.id))}</p>
      <form
        class="fields"
        onSubmit={(event) => {
          event.preventDefault();
          void pair();
        }}
      >
        <div class="field">
          <label for="claim-code">{texts.code}</label>
          <input
            id="claim-code"
            ref={code}
            class="code"
            data-testid="claim-code"
            type="text"
            autocomplete="off"
            autocapitalize="characters"
            spellcheck={false}
            placeholder={texts.example}
            maxLength={20}
            required
            value={typed}
            aria-invalid={error !== ""}
            aria-describedby="claim-answer"
            onInput={(event) => setTyped(event.currentTarget.value)}
          />
        </div>
        <div class="field">
          <label for="claim-space">{texts.space}</label>
          <select
            id="claim-space"
            data-testid="claim-space"
            value={space}
            onChange={(event) => setSpace(event.currentTarget.value)}
          >
            {(spaces ?? []).length === 0 && <option value="">{texts.firstSpace}</option>}
            {spaces?.map(({ id, name: label }, index) => (
              <option key={id} value={index === 0 && space === "" ? "" : id}>
                {label}
              </option>
            ))}
            <option value={NEW}>{texts.newSpace}</option>
          </select>
        </div>
        {space === NEW && (
          <div class="field">
            <label for="claim-space-name">{texts.spaceName}</label>
            <input
              id="claim-space-name"
              type="text"
              autocomplete="off"
              required
              maxLength={200}
              value={name}
              onInput={(event) => setName(event.currentTarget.value)}
            />
          </div>
        )}
        <div class="row">
          <button type="submit" class="primary" data-testid="claim" disabled={busy}>
            {busy ? texts.busy : texts.submit}
          </button>
          {linked !== null && (
            <button
              type="button"
              disabled={busy}
              onClick={() => {
                pairing.drop();
                setTyped("");
              }}
            >
              {texts.discard}
            </button>
          )}
        </div>
        <p id="claim-answer" class="field-error" role="alert">
          {error}
        </p>
      </form>
    </Card>
  );
}

interface PairedProps {
  api: Api;
  fleet: Fleet;
  devices: readonly Device[];
  onAnother: () => void;
}

/** Names the paired devices. They are unknown until the code is claimed. */
function Paired({ api, fleet, devices, onAnother }: PairedProps) {
  const heading = useRef<HTMLHeadingElement>(null);
  useEffect(() => heading.current?.focus(), []);
  return (
    <section class="card" aria-labelledby="paired" data-testid="paired">
      <h2 id="paired" ref={heading} tabIndex={-1}>
        {texts.done(devices.length)}
      </h2>
      <p class="quiet">{texts.doneNote}</p>
      <ul class="paired-list">
        {devices.map((device) => (
          <PairedDevice key={device.id} api={api} fleet={fleet} info={device} />
        ))}
      </ul>
      <div class="row">
        <button type="button" onClick={onAnother}>
          {texts.another}
        </button>
      </div>
    </section>
  );
}

function PairedDevice({ api, fleet, info }: { api: Api; fleet: Fleet; info: Device }) {
  const device = fleet.devices.value?.get(info.id);
  const current = device?.info.value ?? info;
  return (
    <li data-testid="paired-device">
      <a href={deviceAddress(info.id)}>{current.label}</a>
      <span class="quiet small">
        {current.robot_type.replaceAll("_", " ")} · {fleet.spaceName(current.space)}
      </span>
      <span role="status">
        {device === undefined || device.lastSeenAt.value === null ? (
          <span class="quiet small">{texts.waiting}</span>
        ) : (
          <>
            <ReachChip device={device} data-testid="online" />{" "}
            <span class="quiet small" aria-hidden="true">
              <LastSeenAge device={device} />
            </span>
          </>
        )}
      </span>
      {device !== undefined && <RenameDevice api={api} device={device} />}
    </li>
  );
}
