-- Authentication, rosters and message authorization. The functions decide; Prosody stores nothing.
--
-- For each login the module calls the functions (`POST xmpp/verify`). The response contains the user's contacts; contacts
-- are always mutual. Agents and accounts may only communicate with the cloud, never with each other; all other stanzas
-- are rejected.

local async = require "util.async";
local http = require "net.http";
local jid_split = require "util.jid".split;
local json = require "util.json";
local new_sasl = require "util.sasl".new;
local roster_push = require "core.rostermanager".roster_push;
local st = require "util.stanza";

local NAMESPACE = "urn:telescope:v1";
local CLOUD = "cloud";
local VERIFY_URL = assert(module:get_option_string("telescope_verify_url"), "telescope_verify_url is not set");

local host = module.host;
local sessions = prosody.hosts[host].sessions;
local contacts = {};  -- user → contact → display name
local admitted = {};  -- user → response to the last login

local function verify(user, password)
	local waiting, done = async.waiter();
	local response;
	local request = {
		method = "POST";
		headers = { ["Content-Type"] = "application/json" };
		body = json.encode({ user = user, password = password });
	};
	http.request(VERIFY_URL, request, function (body, code)
		if code == 200 then
			response = json.decode(body);
		elseif code ~= 401 then
			module:log("error", "login request to %s failed with status %s", VERIFY_URL, tostring(code));
		end
		done();
	end);
	waiting();
	return response;
end

-- ------------------------------------------------------------ rosters

local function roster_item(name)
	return { subscription = "both", name = name, groups = {}, persist = false };
end

local function add_contact(user, contact, name)
	contacts[user] = contacts[user] or {};
	if contacts[user][contact] == name then return; end
	contacts[user][contact] = name;
	local roster_cache = prosody.hosts[host].roster_cache;
	if roster_cache then roster_cache:set(user.."@"..host, nil); end
	local user_sessions = sessions[user];
	if user_sessions and user_sessions.roster then
		local jid = contact.."@"..host;
		user_sessions.roster[jid] = roster_item(name);
		roster_push(user, host, jid);
	end
end

local function remove_contact(user, contact)
	if contacts[user] == nil or contacts[user][contact] == nil then return; end
	contacts[user][contact] = nil;
	if next(contacts[user]) == nil then contacts[user] = nil; end
	local roster_cache = prosody.hosts[host].roster_cache;
	if roster_cache then roster_cache:set(user.."@"..host, nil); end
	local user_sessions = sessions[user];
	if user_sessions and user_sessions.roster then
		local jid = contact.."@"..host;
		user_sessions.roster[jid] = nil;
		roster_push(user, host, jid);
	end
end

module:hook("roster-load", function (event)
	for contact, name in pairs(contacts[event.username] or {}) do
		event.roster[contact.."@"..host] = roster_item(name);
	end
end);

local function end_sessions(user, reason)
	local user_sessions = sessions[user];
	if not user_sessions then return; end
	local open = {};
	for _, session in pairs(user_sessions.sessions) do open[#open + 1] = session; end
	for _, session in ipairs(open) do
		session:close({ condition = "policy-violation", text = reason });
	end
end

local function revoke(user)
	end_sessions(user, "the cloud ended this session");
	local former = {};
	for contact in pairs(contacts[user] or {}) do former[#former + 1] = contact; end
	for _, contact in ipairs(former) do
		remove_contact(user, contact);
		remove_contact(contact, user);
	end
	admitted[user] = nil;
end

-- ------------------------------------------------------------ authentication

local function authenticate(user, password)
	if #password > 4096 then return false; end
	local response = verify(user, password);
	if type(response) ~= "table" or response.user ~= user then return false; end
	admitted[user] = response;
	local listed = {};
	for _, contact in ipairs(response.contacts) do
		listed[contact.user] = true;
		add_contact(user, contact.user, contact.name);
		add_contact(contact.user, user, response.name);
	end
	-- Remove contacts that the functions no longer list. The cloud keeps all users as contacts.
	local removed = {};
	for contact in pairs(user ~= CLOUD and contacts[user] or {}) do
		if not listed[contact] then removed[#removed + 1] = contact; end
	end
	for _, contact in ipairs(removed) do
		remove_contact(user, contact);
		remove_contact(contact, user);
	end
	return true;
end

local provider = {};

function provider.test_password(user, password) return authenticate(user, password); end
function provider.user_exists(user) return user == CLOUD or contacts[user] ~= nil; end
function provider.get_password() return nil, "Passwords are not stored."; end
function provider.set_password() return nil, "Passwords are not stored."; end
function provider.create_user() return nil, "Accounts are created by the functions."; end
function provider.delete_user() return nil, "The functions delete accounts."; end
function provider.get_sasl_handler()
	return new_sasl(host, {
		plain_test = function (_, user, password) return authenticate(user, password), true; end
	});
end

module:provides("auth", provider);

-- A session ends with its password's lifetime; the client then logs in again. The cloud's session does not expire.
module:hook("authentication-success", function (event)
	local session = event.session;
	local response = admitted[session.username];
	session.telescope = response and response.kind;
	if session.telescope == CLOUD then return; end
	module:add_timer(response and response.lifetime_s or 0, function ()
		if not session.destroyed and session.conn then
			session:close({ condition = "policy-violation", text = "the password has expired" });
		end
	end);
end);

-- ------------------------------------------------------------ authorization of stanzas

local RELATIONS = { subscribe = true, subscribed = true, unsubscribe = true, unsubscribed = true };

local function is_allowed(session, stanza)
	if stanza.name == "presence" and RELATIONS[stanza.attr.type or ""] then return false; end
	if stanza.name == "iq" and stanza.attr.type == "set" and stanza:get_child("query", "jabber:iq:roster") then
		return false;
	end
	local to = stanza.attr.to;
	if to == nil then return true; end
	local user, domain = jid_split(to);
	if domain ~= host then return false; end
	if user == session.username then return true; end
	if session.telescope == CLOUD then return true; end
	if user == nil then return stanza.name == "iq"; end
	if stanza.name == "presence" then return (contacts[session.username] or {})[user] ~= nil; end
	return user == CLOUD and stanza.name == "message";
end

module:hook("pre-stanza", function (event)
	local session, stanza = event.origin, event.stanza;
	if session.type ~= "c2s" or is_allowed(session, stanza) then return; end
	if stanza.attr.type ~= "error" and (stanza.name == "message" or stanza.attr.type == "get" or stanza.attr.type == "set") then
		session.send(st.error_reply(stanza, "auth", "forbidden"));
	end
	return true;
end, 1000);

-- Only the cloud may send messages to the host.
module:hook("message/host", function (event)
	if event.origin.telescope ~= CLOUD then return; end
	local order = event.stanza:get_child("forget", NAMESPACE);
	if order and order.attr.user and order.attr.user ~= CLOUD then
		revoke(order.attr.user);
		return true;
	end
end, 1000);

-- ------------------------------------------------------------ timeouts

-- Agents and the cloud send data every few seconds; on a timeout the session ends and its contacts are notified.
-- Other clients may be silent: Prosody's own hook, which runs after this one, sends them a keep-alive.
module:hook("c2s-read-timeout", function (event)
	local kind = event.session.telescope;
	if kind == CLOUD or kind == "agent" then return false; end
end, 100);
