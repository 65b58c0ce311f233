import numpy as np

import fusion_gym

card = fusion_gym.zoo.card("tobit_oscillator_sensors")
test = card["test"]
print(card["env"], card["options"])
print(f"{test['episodes']} episodes from seed {test['seed']}")
print("price   rate    MSE, 95 % interval")
for price, point in zip(test["prices"], test["points"], strict=True):
    rate, mse = np.mean(point["rate"]), point["mse"]
    print(f"{price:<7.3g} {rate:.3f}  {mse['mean']:.3f} [{mse['low']:.3f}, {mse['high']:.3f}]")
