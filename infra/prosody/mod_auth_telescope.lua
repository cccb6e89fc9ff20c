-- Who may log in, who knows whom, and who may speak to whom. All of it is what the functions say: Prosody keeps nothing.
--
-- A login is a question to the functions (`POST xmpp/verify`). Their answer names the user's contacts; a contact is known
-- on both sides, or on none. An agent and an account speak with the cloud only, never with each other: whatever else a
-- client sends is refused.

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
local contacts = {};  -- user → user → name for people
local admitted = {};  -- user → what the functions said at the newest login

local function ask(user, password)
	local waiting, done = async.waiter();
	local answer;
	local request = {
		method = "POST";
		headers = { ["Content-Type"] = "application/json" };
		body = json.encode({ user = user, password = password });
	};
	http.request(VERIFY_URL, request, function (body, code)
		if code == 200 then
			answer = json.decode(body);
		elseif code ~= 401 then
			module:log("error", "the functions at %s answered a login with %s", VERIFY_URL, tostring(code));
		end
		done();
	end);
	waiting();
	return answer;
end

-- ------------------------------------------------------------ who knows whom

local function item(name)
	return { subscription = "both", name = name, groups = {}, persist = false };
end

local function introduce_to(user, contact, name)
	contacts[user] = contacts[user] or {};
	if contacts[user][contact] == name then return; end
	contacts[user][contact] = name;
	local roster_cache = prosody.hosts[host].roster_cache;
	if roster_cache then roster_cache:set(user.."@"..host, nil); end
	local here = sessions[user];
	if here and here.roster then
		local jid = contact.."@"..host;
		here.roster[jid] = item(name);
		roster_push(user, host, jid);
	end
end

local function part_from(user, contact)
	if contacts[user] == nil or contacts[user][contact] == nil then return; end
	contacts[user][contact] = nil;
	if next(contacts[user]) == nil then contacts[user] = nil; end
	local roster_cache = prosody.hosts[host].roster_cache;
	if roster_cache then roster_cache:set(user.."@"..host, nil); end
	local here = sessions[user];
	if here and here.roster then
		local jid = contact.."@"..host;
		here.roster[jid] = nil;
		roster_push(user, host, jid);
	end
end

module:hook("roster-load", function (event)
	for contact, name in pairs(contacts[event.username] or {}) do
		event.roster[contact.."@"..host] = item(name);
	end
end);

local function end_sessions(user, why)
	local here = sessions[user];
	if not here then return; end
	local open = {};
	for _, session in pairs(here.sessions) do open[#open + 1] = session; end
	for _, session in ipairs(open) do
		session:close({ condition = "policy-violation", text = why });
	end
end

local function forget(user)
	end_sessions(user, "the cloud ended this session");
	local known = {};
	for contact in pairs(contacts[user] or {}) do known[#known + 1] = contact; end
	for _, contact in ipairs(known) do
		part_from(user, contact);
		part_from(contact, user);
	end
	admitted[user] = nil;
end

-- ------------------------------------------------------------ who may log in

local function test(user, password)
	if #password > 4096 then return false; end
	local answer = ask(user, password);
	if type(answer) ~= "table" or answer.user ~= user then return false; end
	admitted[user] = answer;
	local wanted = {};
	for _, contact in ipairs(answer.contacts) do
		wanted[contact.user] = true;
		introduce_to(user, contact.user, contact.name);
		introduce_to(contact.user, user, answer.name);
	end
	-- Whom the functions do not name any more is forgotten. The cloud knows whoever has come.
	local gone = {};
	for contact in pairs(user ~= CLOUD and contacts[user] or {}) do
		if not wanted[contact] then gone[#gone + 1] = contact; end
	end
	for _, contact in ipairs(gone) do
		part_from(user, contact);
		part_from(contact, user);
	end
	return true;
end

local provider = {};

function provider.test_password(user, password) return test(user, password); end
function provider.user_exists(user) return user == CLOUD or contacts[user] ~= nil; end
function provider.get_password() return nil, "Passwords are not kept."; end
function provider.set_password() return nil, "Passwords are not kept."; end
function provider.create_user() return nil, "The functions make accounts."; end
function provider.delete_user() return nil, "The functions delete accounts."; end
function provider.get_sasl_handler()
	return new_sasl(host, {
		plain_test = function (_, user, password) return test(user, password), true; end
	});
end

module:provides("auth", provider);

-- A session lives no longer than its right: whoever stays logs in again. The cloud's own right does not end.
module:hook("authentication-success", function (event)
	local session = event.session;
	local answer = admitted[session.username];
	session.telescope = answer and answer.kind;
	if session.telescope == CLOUD then return; end
	module:add_timer(answer and answer.lifetime_s or 0, function ()
		if not session.destroyed and session.conn then
			session:close({ condition = "policy-violation", text = "the password has expired" });
		end
	end);
end);

-- ------------------------------------------------------------ who may speak to whom

local RELATIONS = { subscribe = true, subscribed = true, unsubscribe = true, unsubscribed = true };

local function may(session, stanza)
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
	return session.telescope == "agent" and user == CLOUD and stanza.name == "message";
end

module:hook("pre-stanza", function (event)
	local session, stanza = event.origin, event.stanza;
	if session.type ~= "c2s" or may(session, stanza) then return; end
	if stanza.attr.type ~= "error" and (stanza.name == "message" or stanza.attr.type == "get" or stanza.attr.type == "set") then
		session.send(st.error_reply(stanza, "auth", "forbidden"));
	end
	return true;
end, 1000);

-- Only the cloud's messages to the host itself come so far.
module:hook("message/host", function (event)
	if event.origin.telescope ~= CLOUD then return; end
	local order = event.stanza:get_child("forget", NAMESPACE);
	if order and order.attr.user and order.attr.user ~= CLOUD then
		forget(order.attr.user);
		return true;
	end
end, 1000);

-- ------------------------------------------------------------ who is still there

-- Agents and the cloud say something every few seconds: from whom nothing comes is gone, and its contacts are told.
-- An ordinary client need not: it is sent a space, as Prosody does (its own hook, after this one).
module:hook("c2s-read-timeout", function (event)
	local kind = event.session.telescope;
	if kind == CLOUD or kind == "agent" then return false; end
end, 100);
