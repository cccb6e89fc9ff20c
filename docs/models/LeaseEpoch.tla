---------------------------- MODULE LeaseEpoch ----------------------------
(* Leases and epochs of one device. The actions have the names of the code: *)
(* function_app/domain/control/lease.py (acquire, renew, release,           *)
(* invalidate) and device_agent/runtime/authority/lease_gate.py (grant,     *)
(* fence, burn). Messages are never removed: they may arrive late, twice,   *)
(* in any order, or never.                                                  *)
EXTENDS Naturals, FiniteSets

CONSTANTS Operators, None, MaxEpoch,
          NextEpoch,   \* "cloud": cloud epoch + 1; "device": max(cloud, device) + 1
          Restore      \* "old": the epochs of the backup; "fresh": above every granted epoch; "never"

VARIABLES cloud,       \* lease in the tables: epoch, holder
          backup,      \* copy of the lease in a backup
          gate,        \* the device's LeaseGate: epoch, burned, holder of the lease in force
          journal,     \* highest epoch in the device's journal
          messages,    \* all signed commands that were sent
          keys         \* <<operator, epoch>>: who received the setpoint key of an epoch

vars == <<cloud, backup, gate, journal, messages, keys>>

Max(a, b) == IF a > b THEN a ELSE b
Granted == {k[2] : k \in keys} \cup {m.epoch : m \in messages} \cup {cloud.epoch, gate.epoch}
Highest == CHOOSE e \in Granted : \A other \in Granted : other <= e
Next_ == 1 + IF NextEpoch = "device" THEN Max(cloud.epoch, gate.epoch) ELSE cloud.epoch
Message(kind, epoch, holder) == [kind |-> kind, epoch |-> epoch, holder |-> holder]

Init ==
  /\ cloud = [epoch |-> 0, holder |-> None]
  /\ backup = cloud
  /\ gate = [epoch |-> 0, burned |-> 0, holder |-> None]
  /\ journal = 0
  /\ messages = {}
  /\ keys = {}

(* ---- the cloud ---- *)
acquire(o) ==
  /\ cloud.holder \in {None, o}
  /\ Next_ <= MaxEpoch
  /\ cloud' = [epoch |-> Next_, holder |-> o]
  /\ messages' = messages \cup {Message("grant", Next_, o)}
  /\ keys' = keys \cup {<<o, Next_>>}
  /\ UNCHANGED <<backup, gate, journal>>

renew(o) ==
  /\ cloud.holder = o
  /\ messages' = messages \cup {Message("grant", cloud.epoch, o)}
  /\ keys' = keys \cup {<<o, cloud.epoch>>}
  /\ UNCHANGED <<cloud, backup, gate, journal>>

release(o) ==
  /\ cloud.holder = o
  /\ cloud' = [cloud EXCEPT !.holder = None]
  /\ messages' = messages \cup {Message("release", cloud.epoch, None)}
  /\ UNCHANGED <<backup, gate, journal, keys>>

expire ==  \* the lease expires in the cloud; the device decides by its own clock
  /\ cloud.holder # None
  /\ cloud' = [cloud EXCEPT !.holder = None]
  /\ UNCHANGED <<backup, gate, journal, messages, keys>>

invalidate ==  \* a reset of Stop, or a revocation
  /\ Next_ <= MaxEpoch
  /\ cloud' = [epoch |-> Next_, holder |-> None]
  /\ messages' = messages \cup {Message("release", Next_, None)}
  /\ UNCHANGED <<backup, gate, journal, keys>>

back_up ==
  /\ backup' = cloud
  /\ UNCHANGED <<cloud, gate, journal, messages, keys>>

restore ==
  /\ Restore # "never"
  /\ cloud' = IF Restore = "fresh" THEN [epoch |-> Highest, holder |-> None] ELSE backup
  /\ UNCHANGED <<backup, gate, journal, messages, keys>>

(* ---- the device ---- *)
grant(m) ==
  /\ m.kind = "grant"
  /\ m.epoch >= gate.epoch
  /\ m.epoch > gate.burned
  /\ journal' = Max(journal, m.epoch)
  /\ gate' = [gate EXCEPT !.epoch = m.epoch, !.holder = m.holder]
  /\ UNCHANGED <<cloud, backup, messages, keys>>

fence(m) ==  \* a release or reset: it ends its epoch and all earlier ones
  /\ m.kind = "release"
  /\ m.epoch >= gate.epoch
  /\ journal' = Max(journal, m.epoch)
  /\ gate' = [epoch |-> m.epoch, burned |-> m.epoch, holder |-> None]
  /\ UNCHANGED <<cloud, backup, messages, keys>>

burn ==  \* a hold, a Stop, or the expiry of the lease
  /\ gate.holder # None
  /\ gate' = [gate EXCEPT !.burned = gate.epoch, !.holder = None]
  /\ UNCHANGED <<cloud, backup, journal, messages, keys>>

restart ==
  /\ gate' = [epoch |-> journal, burned |-> journal, holder |-> None]
  /\ UNCHANGED <<cloud, backup, journal, messages, keys>>

Next ==
  \/ \E o \in Operators : acquire(o) \/ renew(o) \/ release(o)
  \/ expire \/ invalidate \/ back_up \/ restore
  \/ \E m \in messages : grant(m) \/ fence(m)
  \/ burn \/ restart

Spec == Init /\ [][Next]_vars

(* ---- promises ---- *)
CanMove(o) == gate.holder # None /\ <<o, gate.epoch>> \in keys
AtMostOneHolder == Cardinality({o \in Operators : CanMove(o)}) <= 1
BurnedNeverMoves == gate.holder # None => gate.epoch > gate.burned
JournalCoversGate == journal >= gate.epoch /\ gate.epoch >= gate.burned
EpochsNeverDecrease == [][gate'.epoch >= gate.epoch /\ gate'.burned >= gate.burned]_vars
=============================================================================
