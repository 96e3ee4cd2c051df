CREATE FUNCTION public.cartlab_append_only() RETURNS trigger
    LANGUAGE plpgsql
    AS $$ BEGIN RAISE EXCEPTION 'entries of a gradebook cannot be changed'; END $$;
CREATE TABLE public.batches (
    id integer NOT NULL,
    assignment text NOT NULL,
    at text NOT NULL,
    rubric text NOT NULL
);
CREATE SEQUENCE public.batches_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.batches_id_seq OWNED BY public.batches.id;
CREATE TABLE public.entries (
    batch_id integer NOT NULL,
    "position" integer NOT NULL,
    submission_id integer NOT NULL,
    grading_id integer NOT NULL,
    shared text NOT NULL,
    points double precision NOT NULL,
    out_of double precision NOT NULL
);
CREATE TABLE public.figures (
    grading_id integer NOT NULL,
    "position" integer NOT NULL,
    name text NOT NULL,
    svg bytea NOT NULL
);
CREATE TABLE public.findings (
    grading_id integer NOT NULL,
    found bytea NOT NULL
);
CREATE TABLE public.gradings (
    id integer NOT NULL,
    submission_id integer NOT NULL,
    at text NOT NULL,
    key character varying(255) NOT NULL,
    status text NOT NULL,
    reason text NOT NULL,
    settled boolean NOT NULL,
    points double precision NOT NULL,
    out_of double precision NOT NULL,
    days_late double precision NOT NULL,
    deducted double precision NOT NULL,
    authors text NOT NULL,
    owner text NOT NULL,
    detail text NOT NULL,
    grade text NOT NULL,
    fingerprints bytea NOT NULL
);
CREATE SEQUENCE public.gradings_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.gradings_id_seq OWNED BY public.gradings.id;
CREATE TABLE public.looks (
    id integer NOT NULL,
    grading_id integer NOT NULL,
    at text NOT NULL,
    by text NOT NULL,
    seen boolean NOT NULL
);
CREATE SEQUENCE public.looks_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.looks_id_seq OWNED BY public.looks.id;
CREATE TABLE public.overrides (
    id integer NOT NULL,
    submission_id integer NOT NULL,
    at text NOT NULL,
    criterion text NOT NULL,
    points double precision,
    why text NOT NULL,
    by text NOT NULL,
    authors text NOT NULL,
    comment boolean DEFAULT false NOT NULL
);
CREATE SEQUENCE public.overrides_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.overrides_id_seq OWNED BY public.overrides.id;
CREATE TABLE public.releases (
    id integer NOT NULL,
    assignment character varying(255) NOT NULL,
    at text NOT NULL,
    by text NOT NULL,
    released boolean NOT NULL
);
CREATE SEQUENCE public.releases_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.releases_id_seq OWNED BY public.releases.id;
CREATE TABLE public.request_events (
    id integer NOT NULL,
    submission_id integer NOT NULL,
    at text NOT NULL,
    criterion text NOT NULL,
    what text NOT NULL,
    text text NOT NULL,
    points double precision,
    by text NOT NULL,
    authors text NOT NULL
);
CREATE SEQUENCE public.request_events_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.request_events_id_seq OWNED BY public.request_events.id;
CREATE TABLE public.settings (
    name character varying(60) NOT NULL,
    value text NOT NULL
);
CREATE TABLE public.submissions (
    id integer NOT NULL,
    assignment character varying(255) NOT NULL,
    name character varying(510) NOT NULL
);
CREATE SEQUENCE public.submissions_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.submissions_id_seq OWNED BY public.submissions.id;
ALTER TABLE ONLY public.batches ALTER COLUMN id SET DEFAULT nextval('public.batches_id_seq'::regclass);
ALTER TABLE ONLY public.gradings ALTER COLUMN id SET DEFAULT nextval('public.gradings_id_seq'::regclass);
ALTER TABLE ONLY public.looks ALTER COLUMN id SET DEFAULT nextval('public.looks_id_seq'::regclass);
ALTER TABLE ONLY public.overrides ALTER COLUMN id SET DEFAULT nextval('public.overrides_id_seq'::regclass);
ALTER TABLE ONLY public.releases ALTER COLUMN id SET DEFAULT nextval('public.releases_id_seq'::regclass);
ALTER TABLE ONLY public.request_events ALTER COLUMN id SET DEFAULT nextval('public.request_events_id_seq'::regclass);
ALTER TABLE ONLY public.submissions ALTER COLUMN id SET DEFAULT nextval('public.submissions_id_seq'::regclass);
INSERT INTO public.batches VALUES (1, 'lab', '2026-03-01T00:04:00.000000+00:00', '{"version":1,"title":"Two carts: identification and state feedback","system":{"carts":2,"springs":[false,true,true],"input":{"unit":"V","sign":1,"per_count":null},"position":{"unit":"cm","per_count":null},"columns":{}},"design":null,"required":{"experiments":[{"kind":"decay","carts":[1],"at_least":1},{"kind":"decay","carts":[2],"at_least":1},{"kind":"step","carts":[],"at_least":1},{"kind":"sine","carts":[],"at_least":12},{"kind":"closed_loop","carts":[],"at_least":1}],"initial":["*"],"final":["*"],"state_space":true,"feedback":["gains","prefilter","overshoot_percent","settling_time"]},"late":{"due":null,"percent_per_day":10.0,"grace_days":0.05,"most_percent":50.0},"step":0.25,"flags":{"hz_for_rad_s":0.0,"peak_count":0.0,"peak_for_steady_state":0.0,"peak_to_peak":0.0,"transient_used":0.0,"carts_swapped":0.0,"counts_for_length":0.0,"log10_for_ln":0.0,"factor_of_ten":0.0,"no_fit_done":0.0,"final_off":0.0,"initial_off":0.0,"initial_final_disagree":0.0,"physically_impossible":0.0,"wrong_state_space":0.5,"wrong_gains":0.0,"wrong_prefilter":0.0,"missing":0.0,"data_problem":0.25},"anonymous":false,"examples":[],"students":{"see":"report"},"criteria":[{"id":"pieces","points":1.0,"title":"everything else that the lab asks for","requires":[],"message":"","check":"required","experiments":[]},{"id":"laws","points":1.0,"title":"the final table is possible for a real chain of carts","requires":["pieces","dwells"],"message":"Check the redundancies and the order of the frequencies: a number that follows in two ways must be the same both ways.","check":"laws","frequency_percent":3.0,"damping_percent":30.0},{"id":"state-model","points":2.0,"title":"the state model follows from the table","requires":["pieces","dwells"],"message":"","full_percent":5.0,"none_percent":20.0,"damping_full_percent":40.0,"damping_none_percent":150.0,"check":"state_space","states":[]}]}');
INSERT INTO public.batches VALUES (2, 'lab', '2026-03-01T00:25:00.000000+00:00', '{"version":1,"title":"Two carts: identification and state feedback","system":{"carts":2,"springs":[false,true,true],"input":{"unit":"V","sign":1,"per_count":null},"position":{"unit":"cm","per_count":null},"columns":{}},"design":null,"required":{"experiments":[{"kind":"decay","carts":[1],"at_least":1},{"kind":"decay","carts":[2],"at_least":1},{"kind":"step","carts":[],"at_least":1},{"kind":"sine","carts":[],"at_least":12},{"kind":"closed_loop","carts":[],"at_least":1}],"initial":["*"],"final":["*"],"state_space":true,"feedback":["gains","prefilter","overshoot_percent","settling_time"]},"late":{"due":null,"percent_per_day":10.0,"grace_days":0.05,"most_percent":50.0},"step":0.25,"flags":{"hz_for_rad_s":0.0,"peak_count":0.0,"peak_for_steady_state":0.0,"peak_to_peak":0.0,"transient_used":0.0,"carts_swapped":0.0,"counts_for_length":0.0,"log10_for_ln":0.0,"factor_of_ten":0.0,"no_fit_done":0.0,"final_off":0.0,"initial_off":0.0,"initial_final_disagree":0.0,"physically_impossible":0.0,"wrong_state_space":0.5,"wrong_gains":0.0,"wrong_prefilter":0.0,"missing":0.0,"data_problem":0.25},"anonymous":false,"examples":[],"students":{"see":"report"},"criteria":[{"id":"pieces","points":1.0,"title":"everything else that the lab asks for","requires":[],"message":"","check":"required","experiments":[]},{"id":"laws","points":1.0,"title":"the final table is possible for a real chain of carts","requires":["pieces","dwells"],"message":"Check the redundancies and the order of the frequencies: a number that follows in two ways must be the same both ways.","check":"laws","frequency_percent":3.0,"damping_percent":30.0},{"id":"state-model","points":2.0,"title":"the state model follows from the table","requires":["pieces","dwells"],"message":"","full_percent":5.0,"none_percent":20.0,"damping_full_percent":40.0,"damping_none_percent":150.0,"check":"state_space","states":[]}]}');
INSERT INTO public.entries VALUES (1, 0, 1, 1, '', 2, 4);
INSERT INTO public.entries VALUES (1, 1, 2, 2, '', 2, 4);
INSERT INTO public.entries VALUES (1, 2, 3, 3, '', 2, 4);
INSERT INTO public.entries VALUES (2, 0, 1, 1, '', 3, 4);
INSERT INTO public.entries VALUES (2, 1, 2, 2, '', 1.5, 4);
INSERT INTO public.entries VALUES (2, 2, 4, 4, '', 1.75, 4);
INSERT INTO public.figures VALUES (1, 0, 'a.svg', '\x789cb3292e4bd7b70300075601fa');
INSERT INTO public.findings VALUES (1, '\x789cabae0500017500f9');
INSERT INTO public.gradings VALUES (1, 1, '2026-03-01T00:01:00.000000+00:00', 'key of team-1', 'graded', '', true, 2, 4, 0, 0, '["s-team-1"]', '', '', '{
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
', '\x7465616d2d31');
INSERT INTO public.gradings VALUES (2, 2, '2026-03-01T00:02:00.000000+00:00', 'key of team-2', 'graded', '', true, 2, 4, 1, 0, '["s-team-2"]', '', '', '{
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
', '\x7465616d2d32');
INSERT INTO public.gradings VALUES (3, 3, '2026-03-01T00:03:00.000000+00:00', 'key of old-name', 'graded', '', true, 2, 4, 0, 0, '["cy"]', '', '', '{
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
', '\x6f6c642d6e616d65');
INSERT INTO public.gradings VALUES (4, 4, '2026-03-01T00:24:00.000000+00:00', 'key of new-name', 'graded', '', true, 2, 4, 0, 0, '["cy"]', '', '', '{
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
', '\x6e65772d6e616d65');
INSERT INTO public.looks VALUES (1, 1, '2026-03-01T00:13:00.000000+00:00', 'Ada', true);
INSERT INTO public.looks VALUES (2, 2, '2026-03-01T00:14:00.000000+00:00', 'Ada', true);
INSERT INTO public.looks VALUES (3, 2, '2026-03-01T00:15:00.000000+00:00', 'Bob', false);
INSERT INTO public.overrides VALUES (1, 1, '2026-03-01T00:05:00.000000+00:00', 'pieces', 1, 'all there', 'Ada', '["s-team-1"]', false);
INSERT INTO public.overrides VALUES (2, 1, '2026-03-01T00:06:00.000000+00:00', 'state-model', 2, 'right', 'Ada', '["s-team-1"]', false);
INSERT INTO public.overrides VALUES (3, 1, '2026-02-28T23:37:00.000000+00:00', 'state-model', 1.5, 'not quite: naïve ''x''', 'Bob', '["s-team-1"]', false);
INSERT INTO public.overrides VALUES (4, 2, '2026-03-01T00:08:00.000000+00:00', '(total)', -0.5, 'no names', 'Ada', '["s-team-2"]', false);
INSERT INTO public.overrides VALUES (5, 2, '2026-03-01T00:09:00.000000+00:00', 'laws', 0, 'wrong sign', 'Ada', '["s-team-2"]', false);
INSERT INTO public.overrides VALUES (6, 2, '2026-03-01T00:10:00.000000+00:00', 'laws', NULL, 'taken back', 'Ada', '["s-team-2"]', false);
INSERT INTO public.overrides VALUES (7, 2, '2026-03-01T00:11:00.000000+00:00', 'pieces', NULL, 'Mind the unit.', 'Ada', '["s-team-2"]', true);
INSERT INTO public.overrides VALUES (8, 3, '2026-03-01T00:12:00.000000+00:00', 'laws', 0.25, 'half a law', 'Bob', '["cy"]', false);
INSERT INTO public.overrides VALUES (9, 2, '2026-03-01T00:19:00.000000+00:00', 'laws', 0.75, 'it is', 'Ada', '["s-team-2"]', false);
INSERT INTO public.overrides VALUES (10, 4, '2026-03-01T00:12:00.000000+00:00', 'laws', 0.25, 'half a law', 'Bob', '["cy"]', false);
INSERT INTO public.releases VALUES (1, 'lab', '2026-03-01T00:16:00.000000+00:00', 'prof', true);
INSERT INTO public.request_events VALUES (1, 1, '2026-03-01T00:17:00.000000+00:00', 'laws', 'asked', 'both are there', NULL, 's1', '["s-team-1"]');
INSERT INTO public.request_events VALUES (2, 2, '2026-03-01T00:18:00.000000+00:00', 'laws', 'asked', 'the sign is right', NULL, 's2', '["s-team-2"]');
INSERT INTO public.request_events VALUES (3, 2, '2026-03-01T00:20:00.000000+00:00', 'laws', 'answered', 'it is', 0.75, 'Ada', '["s-team-2"]');
INSERT INTO public.request_events VALUES (4, 3, '2026-03-01T00:21:00.000000+00:00', 'pieces', 'asked', 'look again', NULL, 'cy', '["cy"]');
INSERT INTO public.request_events VALUES (5, 3, '2026-03-01T00:22:00.000000+00:00', 'pieces', 'answered', 'no', NULL, 'Ada', '["cy"]');
INSERT INTO public.request_events VALUES (6, 3, '2026-03-01T00:23:00.000000+00:00', 'pieces', 'reopened', '', NULL, 'Ada', '["cy"]');
INSERT INTO public.request_events VALUES (7, 4, '2026-03-01T00:21:00.000000+00:00', 'pieces', 'asked', 'look again', NULL, 'cy', '["cy"]');
INSERT INTO public.request_events VALUES (8, 4, '2026-03-01T00:22:00.000000+00:00', 'pieces', 'answered', 'no', NULL, 'Ada', '["cy"]');
INSERT INTO public.request_events VALUES (9, 4, '2026-03-01T00:23:00.000000+00:00', 'pieces', 'reopened', '', NULL, 'Ada', '["cy"]');
INSERT INTO public.settings VALUES ('schema', '1');
INSERT INTO public.submissions VALUES (1, 'lab', 'team-1');
INSERT INTO public.submissions VALUES (2, 'lab', 'team-2');
INSERT INTO public.submissions VALUES (3, 'lab', 'old-name');
INSERT INTO public.submissions VALUES (4, 'lab', 'new-name');
SELECT pg_catalog.setval('public.batches_id_seq', 2, true);
SELECT pg_catalog.setval('public.gradings_id_seq', 4, true);
SELECT pg_catalog.setval('public.looks_id_seq', 3, true);
SELECT pg_catalog.setval('public.overrides_id_seq', 10, true);
SELECT pg_catalog.setval('public.releases_id_seq', 1, true);
SELECT pg_catalog.setval('public.request_events_id_seq', 9, true);
SELECT pg_catalog.setval('public.submissions_id_seq', 4, true);
ALTER TABLE ONLY public.batches
    ADD CONSTRAINT batches_pkey PRIMARY KEY (id);
ALTER TABLE ONLY public.entries
    ADD CONSTRAINT entries_pkey PRIMARY KEY (batch_id, "position");
ALTER TABLE ONLY public.figures
    ADD CONSTRAINT figures_pkey PRIMARY KEY (grading_id, "position");
ALTER TABLE ONLY public.findings
    ADD CONSTRAINT findings_pkey PRIMARY KEY (grading_id);
ALTER TABLE ONLY public.gradings
    ADD CONSTRAINT gradings_pkey PRIMARY KEY (id);
ALTER TABLE ONLY public.looks
    ADD CONSTRAINT looks_pkey PRIMARY KEY (id);
ALTER TABLE ONLY public.overrides
    ADD CONSTRAINT overrides_pkey PRIMARY KEY (id);
ALTER TABLE ONLY public.releases
    ADD CONSTRAINT releases_pkey PRIMARY KEY (id);
ALTER TABLE ONLY public.request_events
    ADD CONSTRAINT request_events_pkey PRIMARY KEY (id);
ALTER TABLE ONLY public.settings
    ADD CONSTRAINT settings_pkey PRIMARY KEY (name);
ALTER TABLE ONLY public.submissions
    ADD CONSTRAINT submissions_assignment_name_key UNIQUE (assignment, name);
ALTER TABLE ONLY public.submissions
    ADD CONSTRAINT submissions_pkey PRIMARY KEY (id);
CREATE INDEX entries_by_submission ON public.entries USING btree (submission_id);
CREATE INDEX gradings_by_key ON public.gradings USING btree (key);
CREATE INDEX gradings_by_submission ON public.gradings USING btree (submission_id);
CREATE INDEX looks_by_grading ON public.looks USING btree (grading_id);
CREATE INDEX overrides_by_submission ON public.overrides USING btree (submission_id);
CREATE INDEX request_events_by_submission ON public.request_events USING btree (submission_id);
CREATE TRIGGER batches_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.batches FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER entries_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.entries FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER figures_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.figures FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER findings_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.findings FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER gradings_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.gradings FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER looks_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.looks FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER overrides_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.overrides FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER releases_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.releases FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER request_events_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.request_events FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER settings_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.settings FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
CREATE TRIGGER submissions_append_only BEFORE DELETE OR UPDATE OR TRUNCATE ON public.submissions FOR EACH STATEMENT EXECUTE FUNCTION public.cartlab_append_only();
ALTER TABLE ONLY public.entries
    ADD CONSTRAINT entries_batch_id_fkey FOREIGN KEY (batch_id) REFERENCES public.batches(id);
ALTER TABLE ONLY public.entries
    ADD CONSTRAINT entries_grading_id_fkey FOREIGN KEY (grading_id) REFERENCES public.gradings(id);
ALTER TABLE ONLY public.entries
    ADD CONSTRAINT entries_submission_id_fkey FOREIGN KEY (submission_id) REFERENCES public.submissions(id);
ALTER TABLE ONLY public.figures
    ADD CONSTRAINT figures_grading_id_fkey FOREIGN KEY (grading_id) REFERENCES public.gradings(id);
ALTER TABLE ONLY public.findings
    ADD CONSTRAINT findings_grading_id_fkey FOREIGN KEY (grading_id) REFERENCES public.gradings(id);
ALTER TABLE ONLY public.gradings
    ADD CONSTRAINT gradings_submission_id_fkey FOREIGN KEY (submission_id) REFERENCES public.submissions(id);
ALTER TABLE ONLY public.looks
    ADD CONSTRAINT looks_grading_id_fkey FOREIGN KEY (grading_id) REFERENCES public.gradings(id);
ALTER TABLE ONLY public.overrides
    ADD CONSTRAINT overrides_submission_id_fkey FOREIGN KEY (submission_id) REFERENCES public.submissions(id);
ALTER TABLE ONLY public.request_events
    ADD CONSTRAINT request_events_submission_id_fkey FOREIGN KEY (submission_id) REFERENCES public.submissions(id);
