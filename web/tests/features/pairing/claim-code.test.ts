import { describe, expect, it } from "vitest";
import { FollowedCode, pairingCode, readCode } from "../../../src/features/pairing/model/claim-code";
import { FakeStorage } from "../../support/fake-storage";

describe("a claim code", () => {
  it.each(["BCDF-GHJK", "bcdfghjk", " bcdf ghjk ", "BCDF–GHJK"])("is read as it is typed: %s", (typed) => {
    expect(readCode(typed)).toBe("BCDF-GHJK");
  });

  it.each(["", "BCDF-GHJ", "BCDF-GHJKL", "ABCD-EFGH", "BCDF-GH1K"])("is none: %s", (typed) => {
    expect(readCode(typed)).toBeNull();
  });

  it("is taken from a link's fragment, and from nothing that only begins so", () => {
    expect(pairingCode("#pair=BCDF-GHJK")).toBe("BCDF-GHJK");
    expect(pairingCode("#pair=bcdfghjk")).toBe("BCDF-GHJK");
    for (const hash of ["", "#/", "#pair=", "#pair=BCDF-GHJK&x=1", "#pair=<b>BCDFGHJK", "#x#pair=BCDF-GHJK"]) {
      expect(pairingCode(hash)).toBeNull();
    }
  });

  it("of a followed link survives an external sign-in, until it is used", () => {
    const storage = new FakeStorage();
    new FollowedCode(storage).follow("BCDF-GHJK");
    const reloaded = new FollowedCode(storage);
    expect(reloaded.code.value).toBe("BCDF-GHJK");
    reloaded.drop();
    expect(new FollowedCode(storage).code.value).toBeNull();
  });
});
