import { beforeEach, describe, expect, test } from "vitest";
import { ApiError, type Http } from "../../../src/shared/api/http";
import { StoredValue, storedDraft, type Draft } from "../../../src/shared/lib/local-storage";
import { Library, type MovementSource } from "../../../src/shared/api/movement-library";
import { ScriptDraft } from "../../../src/features/movements/model/script-draft";
import { failureMark, rangeOf } from "../../../src/features/movements/model/text-offsets";
import { FakeStorage } from "../../support/fake-storage";

/** The movements of one account. */
class FakeLibrary {
  versions: string[] = [];
  broken = false;

  readonly api = new Library({
    call: (method: string, path: string, options?: { body: { source: string; based_on: number } }) => {
      if (this.broken) return Promise.reject(new ApiError(0, "unreachable", "The server cannot be reached."));
      const version = this.versions.length;
      if (method === "GET") {
        if (version === 0) return Promise.reject(new ApiError(404, "movement-unknown", "The movement does not exist."));
        return Promise.resolve({ version, source: this.versions.at(-1) });
      }
      const body = options?.body ?? { source: "", based_on: 0 };
      if (body.source.includes("(((")) return Promise.reject(new ApiError(422, "movement-invalid", "Line 1: no."));
      if (body.based_on !== version) return Promise.reject(new ApiError(409, "movement-changed", path, { version }));
      this.versions.push(body.source);
      return Promise.resolve({ version: version + 1 } as MovementSource);
    },
  } as unknown as Http);
}

let server: FakeLibrary;
let storage: FakeStorage;

function stored(): StoredValue<Draft> {
  return storedDraft(storage, "ann", "ur5", "wave");
}

async function open(): Promise<ScriptDraft> {
  const script = new ScriptDraft(server.api, "ur5", "wave", stored(), "template");
  await script.load();
  return script;
}

beforeEach(() => {
  server = new FakeLibrary();
  storage = new FakeStorage();
});

describe("a script", () => {
  test("starts with the template, and is saved as the first version", async () => {
    const script = await open();
    expect([script.text.value, script.changed.value]).toEqual(["template", true]);
    script.edit("robot.home()");
    expect(await script.save()).toBe(true);
    expect([server.versions, script.base.value?.version, script.changed.value]).toEqual([["robot.home()"], 1, false]);
    expect(stored().read()).toBeNull();
  });

  test("is restored after a reload, and can be discarded", async () => {
    server.versions = ["saved"];
    (await open()).edit("unsaved");
    const again = await open();
    expect(again.text.value).toBe("unsaved");
    expect(again.restored.value).not.toBeNull();
    expect(again.discard()).toBe("unsaved");
    expect([again.text.value, again.restored.value]).toEqual(["saved", null]);
    expect((await open()).text.value).toBe("saved");
  });

  test("stays in the editor when it is rejected or the server is unreachable", async () => {
    const script = await open();
    script.edit("(((");
    expect(await script.save()).toBe(false);
    expect([script.text.value, script.saveError.value]).toEqual(["(((", "Line 1: no."]);
    server.broken = true;
    script.edit("good");
    expect(await script.save()).toBe(false);
    expect(script.text.value).toBe("good");
    server.broken = false;
    expect(await script.save()).toBe(true);
    expect(script.saveError.value).toBe("");
  });

  test("does not overwrite a version of another tab; either can be chosen", async () => {
    server.versions = ["one"];
    const [mine, other] = [await open(), await open()];
    other.edit("theirs");
    await other.save();
    mine.edit("mine");
    expect(await mine.save()).toBe(false);
    expect(mine.conflict.value?.theirs).toMatchObject({ version: 2, source: "theirs" });
    expect(mine.text.value).toBe("mine");
    expect(await mine.saveOver()).toBe(true);
    expect(server.versions).toEqual(["one", "theirs", "mine"]);
    other.edit("more");
    expect(await other.save()).toBe(false);
    expect(other.takeTheirs()).toBe("more");
    expect([other.text.value, other.changed.value, other.conflict.value]).toEqual(["mine", false, null]);
  });

  test("conflicts if it was restored and is based on an older version", async () => {
    server.versions = ["one"];
    (await open()).edit("mine");
    server.versions.push("two");
    const again = await open();
    expect(again.text.value).toBe("mine");
    expect(await again.save()).toBe(false);
    expect(again.conflict.value?.theirs?.source).toBe("two");
  });
});

describe("positions in a text", () => {
  const mark = { severity: "error", message: "x" } as const;

  test("convert from characters to UTF-16 units", () => {
    const text = "a = 1\r\n'🤖'; b\nc";
    expect(rangeOf(text.replace("\r", ""), { ...mark, line: 2, column: 5, end_line: 2, end_column: 6 })).toMatchObject({ from: 12, to: 13 });
  });

  test("are inside of it and not empty", () => {
    expect(rangeOf("ab", { ...mark, line: 9, column: 9, end_line: 1, end_column: 0 })).toMatchObject({ from: 2, to: 2 });
    expect(rangeOf("ab\ncd", { ...mark, line: 1, column: 0, end_line: 1, end_column: 0 })).toMatchObject({ from: 0, to: 1 });
  });

  test("are read from the error of a run", () => {
    expect(failureMark("line 3: RobotError: no way")).toMatchObject({ line: 3, message: "RobotError: no way" });
    expect(failureMark("the operator pressed Stop")).toBeNull();
  });
});
