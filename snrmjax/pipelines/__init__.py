"""The commands as functions with plain results; `snrmjax.write_results` writes the results.

Each command in Python, with `import snrmjax as sj` and `from snrmjax.pipelines import *`:

    model, data = read_test("measured.csv", "model.toml")
    sj.write_results(run_whole_test("folder"), "out")  # test
    sj.write_results(import_test(["a.mat"], force="CH1", response=["CH2:acceleration:g"]), "out")
    sj.write_results(check_files(["measured.csv"], "model.toml"), "out")
    sj.write_results(find_linear_modes(read_modal_sources(["frf.uff"])), "out")  # modes
    sj.write_results(identify_test(data, model, fit="auto", predict_force=(0.5,)), "out")
    sj.write_results(diagnose_test(data, model), "out")
    tests = [test for file in ["a.csv", "b.csv"] for test in read_measured_test(file, model)]
    sj.write_results(sj.methods.compare_methods(tests, model.modes), "out")  # compare
    sj.write_results(simulate_responses(model, [0.5, 1.0], 60, 110), "out")  # simulate
    sj.write_results(simulate_mode(model, 100), "out")  # nnm
    sj.write_results(reduce_model(read_reduction_source("beam.toml")), "out")  # rom
    sj.study.run_study(sj.study.read_study("study.toml"), "study.zarr")  # study run
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
