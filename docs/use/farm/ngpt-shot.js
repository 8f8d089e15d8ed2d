// A job type of Flamenco 3: put this file into the folder `scripts` of the manager. Workers need `ngpt` on their PATH.
const JOB_TYPE = {
    label: "ngpt shot",
    settings: [
        { key: "scene", type: "string", subtype: "file_path", required: true, description: "Mitsuba scene file" },
        { key: "out", type: "string", subtype: "dir_path", required: true, description: "Folder for stacks and images" },
        { key: "frames", type: "string", required: true, default: "0-119" },
        { key: "chunk_size", type: "int32", default: 8, description: "Frames of a task" },
        { key: "spp", type: "int32", default: 32, description: "Samples per pixel" },
    ],
};

function compileJob(job) {
    const { scene, out, frames, chunk_size, spp } = job.settings;
    const denoise = ngpt("denoise", ["denoise", `${out}/stacks`, "-o", `${out}/clean`, "--temporal", "--skip-existing"]);
    for (const chunk of frameChunker(frames, chunk_size)) {
        const render = ngpt(`render-${chunk}`, ["render", scene, "--frames", chunk, "--spp", `${spp}`,
            "--sampler", "gpt", "--skip-existing", "-o", `${out}/stacks`]);
        denoise.addDependency(render);
        job.addTask(render);
    }
    job.addTask(denoise);
}

function ngpt(name, args) {
    const task = author.Task(name, "misc");
    task.addCommand(author.Command("exec", { exe: "ngpt", args: args }));
    return task;
}
