BEGIN TRANSACTION;
CREATE TABLE batches (
	id INTEGER NOT NULL, 
	assignment TEXT NOT NULL, 
	at TEXT NOT NULL, 
	rubric TEXT NOT NULL, 
	PRIMARY KEY (id)
);
INSERT INTO "batches" VALUES(1,'lab','2026-03-01T00:04:00.000000+00:00','{"version":1,"title":"Two carts: identification and state feedback","system":{"carts":2,"springs":[false,true,true],"input":{"unit":"V","sign":1,"per_count":null},"position":{"unit":"cm","per_count":null},"columns":{}},"design":null,"required":{"experiments":[{"kind":"decay","carts":[1],"at_least":1},{"kind":"decay","carts":[2],"at_least":1},{"kind":"step","carts":[],"at_least":1},{"kind":"sine","carts":[],"at_least":12},{"kind":"closed_loop","carts":[],"at_least":1}],"initial":["*"],"final":["*"],"state_space":true,"feedback":["gains","prefilter","overshoot_percent","settling_time"]},"late":{"due":null,"percent_per_day":10.0,"grace_days":0.05,"most_percent":50.0},"step":0.25,"flags":{"hz_for_rad_s":0.0,"peak_count":0.0,"peak_for_steady_state":0.0,"peak_to_peak":0.0,"transient_used":0.0,"carts_swapped":0.0,"counts_for_length":0.0,"log10_for_ln":0.0,"factor_of_ten":0.0,"no_fit_done":0.0,"final_off":0.0,"initial_off":0.0,"initial_final_disagree":0.0,"physically_impossible":0.0,"wrong_state_space":0.5,"wrong_gains":0.0,"wrong_prefilter":0.0,"missing":0.0,"data_problem":0.25},"anonymous":false,"examples":[],"students":{"see":"report"},"criteria":[{"id":"pieces","points":1.0,"title":"everything else that the lab asks for","requires":[],"message":"","check":"required","experiments":[]},{"id":"laws","points":1.0,"title":"the final table is possible for a real chain of carts","requires":["pieces","dwells"],"message":"Check the redundancies and the order of the frequencies: a number that follows in two ways must be the same both ways.","check":"laws","frequency_percent":3.0,"damping_percent":30.0},{"id":"state-model","points":2.0,"title":"the state model follows from the table","requires":["pieces","dwells"],"message":"","full_percent":5.0,"none_percent":20.0,"damping_full_percent":40.0,"damping_none_percent":150.0,"check":"state_space","states":[]}]}');
INSERT INTO "batches" VALUES(2,'lab','2026-03-01T00:25:00.000000+00:00','{"version":1,"title":"Two carts: identification and state feedback","system":{"carts":2,"springs":[false,true,true],"input":{"unit":"V","sign":1,"per_count":null},"position":{"unit":"cm","per_count":null},"columns":{}},"design":null,"required":{"experiments":[{"kind":"decay","carts":[1],"at_least":1},{"kind":"decay","carts":[2],"at_least":1},{"kind":"step","carts":[],"at_least":1},{"kind":"sine","carts":[],"at_least":12},{"kind":"closed_loop","carts":[],"at_least":1}],"initial":["*"],"final":["*"],"state_space":true,"feedback":["gains","prefilter","overshoot_percent","settling_time"]},"late":{"due":null,"percent_per_day":10.0,"grace_days":0.05,"most_percent":50.0},"step":0.25,"flags":{"hz_for_rad_s":0.0,"peak_count":0.0,"peak_for_steady_state":0.0,"peak_to_peak":0.0,"transient_used":0.0,"carts_swapped":0.0,"counts_for_length":0.0,"log10_for_ln":0.0,"factor_of_ten":0.0,"no_fit_done":0.0,"final_off":0.0,"initial_off":0.0,"initial_final_disagree":0.0,"physically_impossible":0.0,"wrong_state_space":0.5,"wrong_gains":0.0,"wrong_prefilter":0.0,"missing":0.0,"data_problem":0.25},"anonymous":false,"examples":[],"students":{"see":"report"},"criteria":[{"id":"pieces","points":1.0,"title":"everything else that the lab asks for","requires":[],"message":"","check":"required","experiments":[]},{"id":"laws","points":1.0,"title":"the final table is possible for a real chain of carts","requires":["pieces","dwells"],"message":"Check the redundancies and the order of the frequencies: a number that follows in two ways must be the same both ways.","check":"laws","frequency_percent":3.0,"damping_percent":30.0},{"id":"state-model","points":2.0,"title":"the state model follows from the table","requires":["pieces","dwells"],"message":"","full_percent":5.0,"none_percent":20.0,"damping_full_percent":40.0,"damping_none_percent":150.0,"check":"state_space","states":[]}]}');
CREATE TABLE entries (
	batch_id INTEGER NOT NULL, 
	position INTEGER NOT NULL, 
	submission_id INTEGER NOT NULL, 
	grading_id INTEGER NOT NULL, 
	shared TEXT NOT NULL, 
	points FLOAT NOT NULL, 
	out_of FLOAT NOT NULL, 
	PRIMARY KEY (batch_id, position), 
	FOREIGN KEY(batch_id) REFERENCES batches (id), 
	FOREIGN KEY(submission_id) REFERENCES submissions (id), 
	FOREIGN KEY(grading_id) REFERENCES gradings (id)
);
INSERT INTO "entries" VALUES(1,0,1,1,'',2.0,4.0);
INSERT INTO "entries" VALUES(1,1,2,2,'',2.0,4.0);
INSERT INTO "entries" VALUES(1,2,3,3,'',2.0,4.0);
INSERT INTO "entries" VALUES(2,0,1,1,'',3.0,4.0);
INSERT INTO "entries" VALUES(2,1,2,2,'',1.5,4.0);
INSERT INTO "entries" VALUES(2,2,4,4,'',1.75,4.0);
CREATE TABLE figures (
	grading_id INTEGER NOT NULL, 
	position INTEGER NOT NULL, 
	name TEXT NOT NULL, 
	svg BLOB NOT NULL, 
	PRIMARY KEY (grading_id, position), 
	FOREIGN KEY(grading_id) REFERENCES gradings (id)
);
INSERT INTO "figures" VALUES(1,0,'a.svg',X'789CB3292E4BD7B70300075601FA');
CREATE TABLE findings (
	grading_id INTEGER NOT NULL, 
	found BLOB NOT NULL, 
	PRIMARY KEY (grading_id), 
	FOREIGN KEY(grading_id) REFERENCES gradings (id)
);
INSERT INTO "findings" VALUES(1,X'789CABAE0500017500F9');
CREATE TABLE gradings (
	id INTEGER NOT NULL, 
	submission_id INTEGER NOT NULL, 
	at TEXT NOT NULL, 
	"key" VARCHAR(255) NOT NULL, 
	status TEXT NOT NULL, 
	reason TEXT NOT NULL, 
	settled BOOLEAN NOT NULL, 
	points FLOAT NOT NULL, 
	out_of FLOAT NOT NULL, 
	days_late FLOAT NOT NULL, 
	deducted FLOAT NOT NULL, 
	authors TEXT NOT NULL, 
	owner TEXT NOT NULL, 
	detail TEXT NOT NULL, 
	grade TEXT NOT NULL, 
	fingerprints BLOB NOT NULL, 
	PRIMARY KEY (id), 
	FOREIGN KEY(submission_id) REFERENCES submissions (id)
);
INSERT INTO "gradings" VALUES(1,1,'2026-03-01T00:01:00.000000+00:00','key of team-1','graded','',1,2.0,4.0,0.0,0.0,'["s-team-1"]','','','{
 "schema": "cartlab-grade/1",
 "submission": "team-1",
 "authors": [
  "s-team-1"
 ],
 "status": "graded",
 "points": 2.0,
 "out_of": 4.0,
 "days_late": 0.0,
 "deducted": 0.0,
 "reason": "",
 "unsettled": false,
 "criteria": [
  {
   "id": "pieces",
   "title": "everything else that the lab asks for",
   "outcome": "partial",
   "points": 0.5,
   "out_of": 1.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  },
  {
   "id": "laws",
   "title": "the final table is possible for a real chain of carts",
   "outcome": "partial",
   "points": 0.5,
   "out_of": 1.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  },
  {
   "id": "state-model",
   "title": "the state model follows from the table",
   "outcome": "partial",
   "points": 1.0,
   "out_of": 2.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  }
 ],
 "flags": [],
 "notes": [],
 "repaired": "",
 "units": null,
 "springs": [],
 "overrides": [],
 "adjustments": [],
 "open": []
}
',X'7465616D2D31');
INSERT INTO "gradings" VALUES(2,2,'2026-03-01T00:02:00.000000+00:00','key of team-2','graded','',1,2.0,4.0,1.0,0.0,'["s-team-2"]','','','{
 "schema": "cartlab-grade/1",
 "submission": "team-2",
 "authors": [
  "s-team-2"
 ],
 "status": "graded",
 "points": 2.0,
 "out_of": 4.0,
 "days_late": 1.0,
 "deducted": 0.0,
 "reason": "",
 "unsettled": false,
 "criteria": [
  {
   "id": "pieces",
   "title": "everything else that the lab asks for",
   "outcome": "partial",
   "points": 0.5,
   "out_of": 1.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  },
  {
   "id": "laws",
   "title": "the final table is possible for a real chain of carts",
   "outcome": "partial",
   "points": 0.5,
   "out_of": 1.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  },
  {
   "id": "state-model",
   "title": "the state model follows from the table",
   "outcome": "partial",
   "points": 1.0,
   "out_of": 2.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  }
 ],
 "flags": [],
 "notes": [],
 "repaired": "",
 "units": null,
 "springs": [],
 "overrides": [],
 "adjustments": [],
 "open": []
}
',X'7465616D2D32');
INSERT INTO "gradings" VALUES(3,3,'2026-03-01T00:03:00.000000+00:00','key of old-name','graded','',1,2.0,4.0,0.0,0.0,'["cy"]','','','{
 "schema": "cartlab-grade/1",
 "submission": "old-name",
 "authors": [
  "cy"
 ],
 "status": "graded",
 "points": 2.0,
 "out_of": 4.0,
 "days_late": 0.0,
 "deducted": 0.0,
 "reason": "",
 "unsettled": false,
 "criteria": [
  {
   "id": "pieces",
   "title": "everything else that the lab asks for",
   "outcome": "partial",
   "points": 0.5,
   "out_of": 1.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  },
  {
   "id": "laws",
   "title": "the final table is possible for a real chain of carts",
   "outcome": "partial",
   "points": 0.5,
   "out_of": 1.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  },
  {
   "id": "state-model",
   "title": "the state model follows from the table",
   "outcome": "partial",
   "points": 1.0,
   "out_of": 2.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  }
 ],
 "flags": [],
 "notes": [],
 "repaired": "",
 "units": null,
 "springs": [],
 "overrides": [],
 "adjustments": [],
 "open": []
}
',X'6F6C642D6E616D65');
INSERT INTO "gradings" VALUES(4,4,'2026-03-01T00:24:00.000000+00:00','key of new-name','graded','',1,2.0,4.0,0.0,0.0,'["cy"]','','','{
 "schema": "cartlab-grade/1",
 "submission": "new-name",
 "authors": [
  "cy"
 ],
 "status": "graded",
 "points": 2.0,
 "out_of": 4.0,
 "days_late": 0.0,
 "deducted": 0.0,
 "reason": "",
 "unsettled": false,
 "criteria": [
  {
   "id": "pieces",
   "title": "everything else that the lab asks for",
   "outcome": "partial",
   "points": 0.5,
   "out_of": 1.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  },
  {
   "id": "laws",
   "title": "the final table is possible for a real chain of carts",
   "outcome": "partial",
   "points": 0.5,
   "out_of": 1.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  },
  {
   "id": "state-model",
   "title": "the state model follows from the table",
   "outcome": "partial",
   "points": 1.0,
   "out_of": 2.0,
   "message": "omega_1 is off.",
   "expected": {
    "omega_1": 19.6
   },
   "found": {
    "omega_1": 3.12
   }
  }
 ],
 "flags": [],
 "notes": [],
 "repaired": "",
 "units": null,
 "springs": [],
 "overrides": [],
 "adjustments": [],
 "open": []
}
',X'6E65772D6E616D65');
CREATE TABLE looks (
	id INTEGER NOT NULL, 
	grading_id INTEGER NOT NULL, 
	at TEXT NOT NULL, 
	"by" TEXT NOT NULL, 
	seen BOOLEAN NOT NULL, 
	PRIMARY KEY (id), 
	FOREIGN KEY(grading_id) REFERENCES gradings (id)
);
INSERT INTO "looks" VALUES(1,1,'2026-03-01T00:13:00.000000+00:00','Ada',1);
INSERT INTO "looks" VALUES(2,2,'2026-03-01T00:14:00.000000+00:00','Ada',1);
INSERT INTO "looks" VALUES(3,2,'2026-03-01T00:15:00.000000+00:00','Bob',0);
CREATE TABLE overrides (
	id INTEGER NOT NULL, 
	submission_id INTEGER NOT NULL, 
	at TEXT NOT NULL, 
	criterion TEXT NOT NULL, 
	points FLOAT, 
	why TEXT NOT NULL, 
	"by" TEXT NOT NULL, 
	authors TEXT NOT NULL, 
	comment BOOLEAN DEFAULT 0 NOT NULL, 
	PRIMARY KEY (id), 
	FOREIGN KEY(submission_id) REFERENCES submissions (id)
);
INSERT INTO "overrides" VALUES(1,1,'2026-03-01T00:05:00.000000+00:00','pieces',1.0,'all there','Ada','["s-team-1"]',0);
INSERT INTO "overrides" VALUES(2,1,'2026-03-01T00:06:00.000000+00:00','state-model',2.0,'right','Ada','["s-team-1"]',0);
INSERT INTO "overrides" VALUES(3,1,'2026-02-28T23:37:00.000000+00:00','state-model',1.5,'not quite: naïve ''x''','Bob','["s-team-1"]',0);
INSERT INTO "overrides" VALUES(4,2,'2026-03-01T00:08:00.000000+00:00','(total)',-0.5,'no names','Ada','["s-team-2"]',0);
INSERT INTO "overrides" VALUES(5,2,'2026-03-01T00:09:00.000000+00:00','laws',0.0,'wrong sign','Ada','["s-team-2"]',0);
INSERT INTO "overrides" VALUES(6,2,'2026-03-01T00:10:00.000000+00:00','laws',NULL,'taken back','Ada','["s-team-2"]',0);
INSERT INTO "overrides" VALUES(7,2,'2026-03-01T00:11:00.000000+00:00','pieces',NULL,'Mind the unit.','Ada','["s-team-2"]',1);
INSERT INTO "overrides" VALUES(8,3,'2026-03-01T00:12:00.000000+00:00','laws',0.25,'half a law','Bob','["cy"]',0);
INSERT INTO "overrides" VALUES(9,2,'2026-03-01T00:19:00.000000+00:00','laws',0.75,'it is','Ada','["s-team-2"]',0);
INSERT INTO "overrides" VALUES(10,4,'2026-03-01T00:12:00.000000+00:00','laws',0.25,'half a law','Bob','["cy"]',0);
CREATE TABLE releases (
	id INTEGER NOT NULL, 
	assignment VARCHAR(255) NOT NULL, 
	at TEXT NOT NULL, 
	"by" TEXT NOT NULL, 
	released BOOLEAN NOT NULL, 
	PRIMARY KEY (id)
);
INSERT INTO "releases" VALUES(1,'lab','2026-03-01T00:16:00.000000+00:00','prof',1);
CREATE TABLE request_events (
	id INTEGER NOT NULL, 
	submission_id INTEGER NOT NULL, 
	at TEXT NOT NULL, 
	criterion TEXT NOT NULL, 
	what TEXT NOT NULL, 
	text TEXT NOT NULL, 
	points FLOAT, 
	"by" TEXT NOT NULL, 
	authors TEXT NOT NULL, 
	PRIMARY KEY (id), 
	FOREIGN KEY(submission_id) REFERENCES submissions (id)
);
INSERT INTO "request_events" VALUES(1,1,'2026-03-01T00:17:00.000000+00:00','laws','asked','both are there',NULL,'s1','["s-team-1"]');
INSERT INTO "request_events" VALUES(2,2,'2026-03-01T00:18:00.000000+00:00','laws','asked','the sign is right',NULL,'s2','["s-team-2"]');
INSERT INTO "request_events" VALUES(3,2,'2026-03-01T00:20:00.000000+00:00','laws','answered','it is',0.75,'Ada','["s-team-2"]');
INSERT INTO "request_events" VALUES(4,3,'2026-03-01T00:21:00.000000+00:00','pieces','asked','look again',NULL,'cy','["cy"]');
INSERT INTO "request_events" VALUES(5,3,'2026-03-01T00:22:00.000000+00:00','pieces','answered','no',NULL,'Ada','["cy"]');
INSERT INTO "request_events" VALUES(6,3,'2026-03-01T00:23:00.000000+00:00','pieces','reopened','',NULL,'Ada','["cy"]');
INSERT INTO "request_events" VALUES(7,4,'2026-03-01T00:21:00.000000+00:00','pieces','asked','look again',NULL,'cy','["cy"]');
INSERT INTO "request_events" VALUES(8,4,'2026-03-01T00:22:00.000000+00:00','pieces','answered','no',NULL,'Ada','["cy"]');
INSERT INTO "request_events" VALUES(9,4,'2026-03-01T00:23:00.000000+00:00','pieces','reopened','',NULL,'Ada','["cy"]');
CREATE TABLE settings (
	name VARCHAR(60) NOT NULL, 
	value TEXT NOT NULL, 
	PRIMARY KEY (name)
);
INSERT INTO "settings" VALUES('schema','1');
CREATE TABLE submissions (
	id INTEGER NOT NULL, 
	assignment VARCHAR(255) NOT NULL, 
	name VARCHAR(510) NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (assignment, name)
);
INSERT INTO "submissions" VALUES(1,'lab','team-1');
INSERT INTO "submissions" VALUES(2,'lab','team-2');
INSERT INTO "submissions" VALUES(3,'lab','old-name');
INSERT INTO "submissions" VALUES(4,'lab','new-name');
CREATE TRIGGER settings_no_update BEFORE UPDATE ON settings BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER settings_no_delete BEFORE DELETE ON settings BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER submissions_no_update BEFORE UPDATE ON submissions BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER submissions_no_delete BEFORE DELETE ON submissions BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER batches_no_update BEFORE UPDATE ON batches BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER batches_no_delete BEFORE DELETE ON batches BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER releases_no_update BEFORE UPDATE ON releases BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER releases_no_delete BEFORE DELETE ON releases BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE INDEX gradings_by_key ON gradings ("key");
CREATE INDEX gradings_by_submission ON gradings (submission_id);
CREATE TRIGGER gradings_no_update BEFORE UPDATE ON gradings BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER gradings_no_delete BEFORE DELETE ON gradings BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE INDEX overrides_by_submission ON overrides (submission_id);
CREATE TRIGGER overrides_no_update BEFORE UPDATE ON overrides BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER overrides_no_delete BEFORE DELETE ON overrides BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE INDEX request_events_by_submission ON request_events (submission_id);
CREATE TRIGGER request_events_no_update BEFORE UPDATE ON request_events BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER request_events_no_delete BEFORE DELETE ON request_events BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER figures_no_update BEFORE UPDATE ON figures BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER figures_no_delete BEFORE DELETE ON figures BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER findings_no_update BEFORE UPDATE ON findings BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER findings_no_delete BEFORE DELETE ON findings BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE INDEX entries_by_submission ON entries (submission_id);
CREATE TRIGGER entries_no_update BEFORE UPDATE ON entries BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER entries_no_delete BEFORE DELETE ON entries BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE INDEX looks_by_grading ON looks (grading_id);
CREATE TRIGGER looks_no_update BEFORE UPDATE ON looks BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
CREATE TRIGGER looks_no_delete BEFORE DELETE ON looks BEGIN SELECT RAISE(ABORT, 'entries of a gradebook cannot be changed'); END;
COMMIT;
