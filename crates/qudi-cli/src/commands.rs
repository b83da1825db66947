//! One folder a command: its options in `args`, what it does in `run`, the rest by its name.

pub(crate) mod bench {
    pub(crate) mod args;
    mod burst;
    pub(crate) mod run;
    mod training;
}

pub(crate) mod calibrate {
    pub(crate) mod args;
    pub(crate) mod run;
}

pub(crate) mod completions {
    pub(crate) mod args;
    pub(crate) mod run;
}

pub(crate) mod config {
    pub(crate) mod args;
    pub(crate) mod run;
}

pub(crate) mod convert {
    pub(crate) mod args;
    pub(crate) mod run;
}

pub(crate) mod demo {
    mod animation;
    pub(crate) mod args;
    mod diffusion;
    mod html;
    mod picture;
    mod restored;
    pub(crate) mod run;
    mod scenes;
    mod uncertainty;
}

pub(crate) mod eval {
    mod about;
    mod appearance;
    pub(crate) mod args;
    mod capture;
    mod clip;
    mod colour;
    mod exact_json;
    mod exposed_clip;
    mod exposing;
    mod external;
    mod html;
    mod join;
    mod mark;
    mod metrics;
    mod perceptual;
    mod plan;
    pub(crate) mod run;
    mod score;
    mod table;
    mod table1;

    pub(crate) use clip::clip_places;
}

pub(crate) mod info {
    pub(crate) mod args;
    pub(crate) mod capture;
    mod record;
    pub(crate) mod run;
}

pub(crate) mod light {
    pub(crate) mod args;
    pub(crate) mod run;
}

pub(crate) mod look {
    pub(crate) mod args;
    mod mosaic;
    pub(crate) mod run;
    mod shown;
    pub(crate) mod strip;
}

pub(crate) mod publish {
    pub(crate) mod args;
    pub(crate) mod run;
}

pub(crate) mod restore {
    pub(crate) mod args;
    pub(crate) mod caller;
    mod challenge;
    mod chi_square_map;
    pub(crate) mod on_demand;
    mod output;
    mod page;
    mod plan;
    pub(crate) mod run;
    mod uncertainty;
    mod y4m;
}

pub(crate) mod selftest {
    pub(crate) mod args;
    pub(crate) mod run;
}

pub(crate) mod simulate {
    pub(crate) mod args;
    mod outputs;
    mod plan;
    pub(crate) mod run;
}

pub(crate) mod train {
    pub(crate) mod args;
    mod data;
    mod environment;
    mod loops;
    mod pictures;
    mod plan;
    mod report;
    mod resume;
    pub(crate) mod run;
    mod run_folder;
    mod stages;
    mod watch;

    pub(crate) use run_folder::run_files;
}

pub(crate) mod view {
    mod address;
    pub(crate) mod args;
    mod frames;
    mod page;
    mod request;
    pub(crate) mod run;
    mod server;
}
