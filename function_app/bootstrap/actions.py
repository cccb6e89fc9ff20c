"""Factories of the actions services, and of autonomy, which reads actions."""

from functools import cached_property

from function_app.bootstrap.control import ControlServices
from function_app.services.actions.acks import ActionAcks
from function_app.services.actions.action_store import ActionStore
from function_app.services.actions.dispatcher import ActionDispatcher
from function_app.services.actions.query import Actions
from function_app.services.actions.queue import ActionQueues
from function_app.services.actions.start import StartAction
from function_app.services.actions.start_many import StartOnMany
from function_app.services.actions.stop import StopDevices
from function_app.services.actions.tasks import RobotTypeTasks
from function_app.services.actions.trial_log import TrialLog
from function_app.services.autonomy.autonomy_reader import AutonomyReader
from function_app.services.autonomy.session_actions import SessionActions
from function_app.services.autonomy.task_reports import TaskReports


class ActionServices(ControlServices):
    """Creates each actions service on first use."""

    @cached_property
    def action_store(self) -> ActionStore:
        return ActionStore(tables=self.tables, metrics=self.metrics)

    @cached_property
    def autonomy(self) -> AutonomyReader:
        return AutonomyReader(
            session_log=self.sessions_of_devices, recordings=self.recordings, action_store=self.action_store
        )

    @cached_property
    def session_actions(self) -> SessionActions:
        return SessionActions(session_log=self.sessions_of_devices)

    @cached_property
    def tasks(self) -> RobotTypeTasks:
        return RobotTypeTasks(robot_types=self.robot_types)

    @cached_property
    def trial_log(self) -> TrialLog:
        return TrialLog(tables=self.tables, retention=self.retention, clock=self.clock)

    @cached_property
    def task_reports(self) -> TaskReports:
        return TaskReports(trial_log=self.trial_log, devices=self.devices, tasks=self.tasks)

    @cached_property
    def dispatcher(self) -> ActionDispatcher:
        return ActionDispatcher(
            tables=self.tables,
            devices=self.devices,
            action_store=self.action_store,
            command_sender=self.command_sender,
            movements=self.movements,
            clock=self.clock,
        )

    @cached_property
    def queues(self) -> ActionQueues:
        return ActionQueues(
            tables=self.tables,
            action_store=self.action_store,
            reminders=self.reminders,
            dispatcher=self.dispatcher,
            control_events=self.control_events,
            trial_log=self.trial_log,
            clock=self.clock,
        )

    @cached_property
    def action_acks(self) -> ActionAcks:
        return ActionAcks(
            action_store=self.action_store,
            queues=self.queues,
            mailbox=self.mailbox,
            latencies=self.latencies,
            metrics=self.metrics,
            tracing=self.tracing,
            clock=self.clock,
        )

    @cached_property
    def start_action(self) -> StartAction:
        return StartAction(
            tables=self.tables,
            devices=self.devices,
            movements=self.movements,
            tasks=self.tasks,
            command_sender=self.command_sender,
            action_store=self.action_store,
            acks=self.action_acks,
            reminders=self.reminders,
            queues=self.queues,
            delivery=self.delivery,
            control_events=self.control_events,
            tracing=self.tracing,
            clock=self.clock,
        )

    @cached_property
    def start_many(self) -> StartOnMany:
        return StartOnMany(start_action=self.start_action)

    @cached_property
    def actions(self) -> Actions:
        return Actions(
            tables=self.tables,
            devices=self.devices,
            action_store=self.action_store,
            acks=self.action_acks,
            command_sender=self.command_sender,
            delivery=self.delivery,
            clock=self.clock,
        )

    @cached_property
    def stop(self) -> StopDevices:
        return StopDevices(
            devices=self.devices,
            spaces=self.spaces,
            lease_store=self.lease_store,
            command_sender=self.command_sender,
            queues=self.queues,
            delivery=self.delivery,
            control_events=self.control_events,
            metrics=self.metrics,
            clock=self.clock,
        )
